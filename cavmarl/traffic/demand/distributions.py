"""Distributions: the two ways in which SUMO's files say what to choose from, and how often."""

from __future__ import annotations

from collections.abc import Sequence

from cavmarl.traffic.demand.demand_records import Options
from cavmarl.traffic.demand.element import Element

MAX_WEIGHT = 1e9


def listed(source: Element, key: str) -> list[tuple[str, float | None]]:
    """Names in one attribute, their weights in another.

    `key`: "vTypes" or "routes".

    Returns:
        Pairs of name and weight; None where `probabilities` says nothing.
    """
    names = source.attrs.get(key, "").split()
    texts = source.attrs.get("probabilities", "").split()
    if texts and len(texts) != len(names):
        raise source.error(
            f"has {len(texts)} probabilities for {len(names)} {key}", "give one for each"
        )
    weights: list[float | None] = [
        source.saying(probabilities=text).number("probabilities", 1.0, least=0.0, most=MAX_WEIGHT)
        for text in texts
    ]
    return list(zip(names, weights or [None] * len(names), strict=True))


def weighted(source: Element, found: Sequence[tuple[int, float]]) -> Options:
    """What is found to choose from, without what is never chosen.

    Raises:
        DemandError: nothing is left.
    """
    kept = [(row, weight) for row, weight in found if weight > 0.0]
    if not kept:
        raise source.error("has nothing to choose from", "give it members with a probability")
    return Options(tuple(row for row, _ in kept), tuple(weight for _, weight in kept))
