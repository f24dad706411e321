"""Strongly connected components of a directed graph."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def strong_components(num_nodes: int, arcs: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the component of every node of a directed graph.

    Kosaraju's algorithm without recursion, because a city's graph is deeper than Python's stack.

    `arcs`: (num_arcs, 2) from-node, to-node.

    Returns (N,) component numbers from 0; nodes that reach each other have the same number.
    """
    onward: list[list[int]] = [[] for _ in range(num_nodes)]
    backward: list[list[int]] = [[] for _ in range(num_nodes)]
    for source, target in arcs.tolist():
        onward[source].append(target)
        backward[target].append(source)

    component = np.full(num_nodes, -1, np.int32)
    count = 0
    for root in reversed(_finishing_order(onward)):
        if component[root] >= 0:
            continue
        component[root] = count
        stack = [root]
        while stack:
            for node in backward[stack.pop()]:
                if component[node] < 0:
                    component[node] = count
                    stack.append(node)
        count += 1
    return component


def _finishing_order(onward: list[list[int]]) -> list[int]:
    """Return all nodes in the order in which a depth-first search finishes them."""
    seen = [False] * len(onward)
    order: list[int] = []
    for root in range(len(onward)):
        if seen[root]:
            continue
        seen[root] = True
        stack = [(root, iter(onward[root]))]
        while stack:
            node, rest = stack[-1]
            fresh = next((after for after in rest if not seen[after]), None)
            if fresh is None:
                order.append(node)
                stack.pop()
            else:
                seen[fresh] = True
                stack.append((fresh, iter(onward[fresh])))
    return order
