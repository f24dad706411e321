"""Joins a Ray cluster, and chooses its nodes for actors."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from cavmarl.balance.load_score import Candidate, Utilisation, select
from cavmarl.core.errors import ConfigError, WorkerError, require

ADDRESS = "RAY_ADDRESS"  # environment variable that Ray itself reads
CALL_S = 5.0
RELEASE_S = 2.0  # time to wait for CPUs, since Ray notices the end of an actor with a delay
_RESOURCES = ("CPU", "memory", "GPU")
# number of calls of `join` that no `leave` has undone; 0 if the program itself has joined
_joined = 0


@dataclass(frozen=True)
class Node:
    """A node of the cluster, as Ray describes it."""

    name: str
    cpus: int  # free CPUs
    use: Utilisation  # reserved share of each resource
    hosted: int = 0  # actors that were assigned to it


def join() -> bool:  # whether `leave` has to be called
    """Join the cluster of this program, or start one on this machine.

    A program that has called `ray.init` is a member already. Otherwise, the program joins the
    cluster at `RAY_ADDRESS`, a cluster that `ray start` has started here, or a new cluster, which
    ends with its last user.

    Raises:
        ConfigError: the program is a Ray client outside of the cluster.
        MissingExtraError: Ray is not installed.
        WorkerError: there is no cluster at the address.
    """
    global _joined
    ray = require("ray", "ray")
    address = os.environ.get(ADDRESS, "")
    if address.startswith("ray://") or ray.util.client.ray.is_connected():
        raise ConfigError(
            "Ray client (ray://): nodes connect to this program, so it has to run on a machine of "
            "the cluster; start it there (ray job submit, or ray exec)"
        )
    if ray.is_initialized() and not _joined:
        return False
    if not ray.is_initialized():
        try:
            _call(address)
            ray.init(include_dashboard=False, log_to_driver=False, logging_level="ERROR")
        except (OSError, RuntimeError, ValueError) as error:
            raise WorkerError(
                f"no Ray cluster at {address or 'the address of the last ray start'}: {error}. "
                f"Start one (ray start --head), or unset {ADDRESS} for one on this machine"
            ) from error
    _joined += 1
    return True


def _call(address: str) -> None:
    """Check that a process listens at the address; Ray would try for minutes."""
    host, colon, port = address.rpartition(":")
    if colon and port.isdigit():
        socket.create_connection((host, int(port)), CALL_S).close()


def leave() -> None:
    """Leave the cluster if no other part of this program uses it; end it if `join` started it."""
    global _joined
    _joined -= 1
    ray = require("ray", "ray")
    if _joined == 0 and ray.is_initialized():
        ray.shutdown()


def nodes() -> list[Node]:
    """Return the live nodes of the cluster, the node of this process first."""
    ray = require("ray", "ray")
    from ray._private.state import available_resources_per_node  # Ray has no public API for it

    free: dict[str, dict[str, float]] = available_resources_per_node()
    here = ray.get_runtime_context().get_node_id()
    alive = [one for one in ray.nodes() if one["Alive"] and one["NodeID"] in free]
    alive.sort(key=lambda one: (one["NodeID"] != here, one["NodeManagerAddress"], one["NodeID"]))
    return [_node(one["NodeID"], one["Resources"], free[one["NodeID"]]) for one in alive]


def nodes_with(cpus: int) -> list[Node]:
    """Return the nodes, after a short wait for CPUs that were just released."""
    until_s = time.monotonic() + RELEASE_S
    while True:
        known = nodes()
        if sum(node.cpus for node in known) >= cpus or time.monotonic() > until_s:
            return known
        time.sleep(0.1)


def choose_nodes(known: Sequence[Node], workers: int) -> list[str]:  # names of nodes
    """Choose for each actor the admissible node with the lowest LoadScore.

    On a tie, the node with the fewest actors is chosen.

    Raises:
        ConfigError: there are too few free CPUs.
        NoAdmissibleWorkerError: too many of the free CPUs are on nodes that are too busy.
    """
    free = sum(node.cpus for node in known)
    if workers > free:
        raise ConfigError(
            f"backend = 'ray:{workers}': the Ray cluster has {free} free CPUs on {len(known)} "
            "nodes; use fewer workers, or add nodes (ray start --address=…); see ray status"
        )
    left = list(known)
    chosen: list[str] = []
    for _ in range(workers):
        candidates = [
            Candidate(k, node.use, node.hosted, available=node.cpus > 0)
            for k, node in enumerate(left)
        ]
        k = select(candidates).worker
        left[k] = replace(left[k], cpus=left[k].cpus - 1, hosted=left[k].hosted + 1)
        chosen.append(left[k].name)
    return chosen


def _node(name: str, total: dict[str, Any], free: dict[str, Any]) -> Node:
    shares = []
    for resource in _RESOURCES:
        has = total.get(resource, 0.0)
        shares.append(min(max(1.0 - free.get(resource, 0.0) / has, 0.0), 1.0) if has else 0.0)
    return Node(name, int(free.get("CPU", 0.0)), Utilisation(*shares))
