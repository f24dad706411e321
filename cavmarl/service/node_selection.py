"""Selection of a node for a session, by eq. (1) and (2) of `cavmarl.balance.load_score`.

Overloaded nodes are excluded. A node is also excluded by its slots, its capabilities, the
identities that it serves, its state, or the age of its last heartbeat. A session assigned since the
last heartbeat is not part of the reported load. It counts as one slot's share of the processor, so
that concurrent requests do not all go to the node that was idle a second ago. That share never
excludes a node.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from cavmarl.balance.load_score import (
    DEFAULT_RULE,
    UNAVAILABLE,
    Candidate,
    LoadRule,
    Utilisation,
    find_rejections,
    load_score,
    select,
)
from cavmarl.core.errors import NoAdmissibleWorkerError, ServiceError
from cavmarl.service.service_records import NodeRecord, SessionRecord

MOST_TOLD = 5  # nodes that a message names


class Exclusion(NamedTuple):
    """A node that is not chosen, and the reason."""

    node: str
    reason: str  # unavailable, stale, draining, capacity, capability, access, cpu, ram, gpu
    value: float | None = None
    threshold: float | None = None


@dataclass
class LiveNode:
    """The part of a node's state that is not in the log: its last heartbeat, and what it hosts.

    Attributes:
        number: order of registration, which breaks ties.
    """

    number: int
    heard_s: float  # time of the last heartbeat by the service's clock
    beat: int = -1  # sequence number of the last heartbeat
    use: Utilisation | None = None  # None: no heartbeat yet
    hosted: set[str] = field(default_factory=set)  # ids of the sessions assigned to the node
    muted: set[str] = field(default_factory=set)  # hosted sessions that are not in `use` yet
    zones_of: list[str] = field(
        default_factory=list
    )  # sessions with zones on this node, once per part of the zones
    counters: dict[str, float] = field(default_factory=dict)  # counters for /metrics
    jobs: dict[str, list[int]] = field(default_factory=dict)  # job → steps done, total
    candidate: Candidate | None = None  # cached input of `select`

    def refresh(self) -> None:
        """Discard the cached candidate after a change of its inputs."""
        self.candidate = None


class Chosen(NamedTuple):
    """The node chosen for a session."""

    node: str
    outcome: str  # reason, as in `balance.load_score.Outcome`, or `preferred unknown`
    score: float
    exclusions: tuple[Exclusion, ...]


class NoNodeError(ServiceError):
    """No node can accept a session now.

    Attributes:
        exclusions: the reason for each node.
    """

    def __init__(self, exclusions: tuple[Exclusion, ...]) -> None:
        told = "; ".join(f"{one.node}: {explain(one)}" for one in exclusions[:MOST_TOLD])
        more = len(exclusions) - MOST_TOLD
        also = f"; and {more} other nodes" if more > 0 else ""
        super().__init__(
            f"no node can take this ({told or 'no node is registered'}{also}). Wait, ask with "
            "wait_s, or start another node: cavmarl node --service URL",
            503,
            "no-node",
        )
        self.exclusions = exclusions


# Reasons of exclusions other than load, and what to do.
_CURES = {
    UNAVAILABLE: "does not answer, or cannot be reached; start it again",
    "stale": "has sent no load lately; it may be starting, or be too slow",
    "draining": "accepts no sessions: cavmarl nodes --resume NODE",
    "capacity": "has no free slot; end a session, or start it with more --slots",
    "capability": "lacks a required capability; start it with --capability",
    "access": "does not serve you; start it with --allow NAME",
}


def explain(one: Exclusion) -> str:
    """Return why a node is excluded, which limit counts, and what to do."""
    if one.value is None or one.threshold is None:
        return _CURES.get(one.reason, one.reason)
    return (
        f"{one.reason} {one.value:.2f} is above the threshold {one.threshold:g}; wait, or raise it "
        "with cavmarl serve --thresholds"
    )


def choose(
    nodes: Mapping[str, NodeRecord],
    live: Mapping[str, LiveNode],
    session: SessionRecord,
    *,
    now_s: float,
    max_age_s: float,  # age of a node's last heartbeat
    avoided: Sequence[str] = (),  # nodes that the client cannot reach
    rule: LoadRule = DEFAULT_RULE,
) -> Chosen:
    """Return the admissible node with the lowest score, or a preferred node with about this score.

    Raises:
        NoNodeError: all nodes are excluded.
    """
    exclusions: list[Exclusion] = []
    candidates: list[Candidate] = []
    names: dict[int, str] = {}
    for name, node in nodes.items():
        known = live[name]
        reason = _reason_against(node, known, session, now_s - known.heard_s > max_age_s)
        if reason is None and name in avoided:
            reason = UNAVAILABLE
        if reason is not None:
            exclusions.append(Exclusion(name, reason))
            continue
        if known.candidate is None:
            known.candidate = _candidate(node, known, rule)
        candidates.append(known.candidate)
        names[known.number] = name
    asked = live.get(session.preferred or "")
    preferred = None if asked is None else asked.number
    is_admissible = preferred in names
    try:
        found = select(candidates, rule, preferred if is_admissible else None)
    except NoAdmissibleWorkerError as error:
        exclusions += [Exclusion(names[one[0]], *one[1:]) for one in error.rejections]
        raise NoNodeError(tuple(exclusions)) from None
    exclusions += [Exclusion(names[one.worker], *one[1:]) for one in found.rejections]
    outcome: str = found.outcome
    if session.preferred is not None and not is_admissible:
        outcome = _why_not(session.preferred, exclusions)
    score = dict(found.scores)[found.worker]
    return Chosen(names[found.worker], outcome, score, tuple(exclusions))


def limits_of(node: NodeRecord, known: LiveNode, is_old: bool, rule: LoadRule) -> list[str]:
    """Return why a node would refuse a session that needs no capabilities, and what to do."""
    reason = _state_against(node, known, is_old)
    if reason is not None:
        return [explain(Exclusion(node.name, reason))]
    assert known.use is not None
    found = find_rejections([Candidate(0, known.use)], rule)
    return [explain(Exclusion(node.name, *one[1:])) for one in found]


def overloads(use: Utilisation, rule: LoadRule = DEFAULT_RULE) -> list[str]:
    """Return the resources above their thresholds."""
    return [one.resource for one in find_rejections([Candidate(0, use)], rule)]


def score_of(node: NodeRecord, known: LiveNode, rule: LoadRule = DEFAULT_RULE) -> float | None:
    """Return a node's LoadScore for selection, or None if it reports no load."""
    if known.use is None:
        return None
    return load_score(_candidate(node, known, rule).use, rule.weights)


def _reason_against(
    node: NodeRecord, known: LiveNode, session: SessionRecord, is_old: bool
) -> str | None:
    """Return the first reason other than load why a node cannot accept a session, or None."""
    state = _state_against(node, known, is_old)
    if state not in (None, "capacity"):
        return state
    if node.allowed and session.owner_name not in node.allowed:
        return "access"
    if session.needs and not set(session.needs) <= set(node.capabilities):
        return "capability"
    return state


def _state_against(node: NodeRecord, known: LiveNode, is_old: bool) -> str | None:
    """Return the reason why a node can accept no session at all, or None."""
    if node.state != "up":
        return UNAVAILABLE
    if is_old or known.use is None:
        return "stale"
    if node.draining:
        return "draining"
    if len(known.hosted) + len(known.zones_of) >= node.slots:
        return "capacity"
    return None


def _candidate(node: NodeRecord, known: LiveNode, rule: LoadRule) -> Candidate:
    use = known.use
    assert use is not None
    reserved = use.cpu + len(known.muted) / node.slots
    cpu = max(use.cpu, min(reserved, rule.thresholds[0]))
    busy = len(known.hosted) + len(known.zones_of)
    return Candidate(known.number, Utilisation(cpu, use.ram, use.gpu), busy)


def _why_not(preferred: str, exclusions: Sequence[Exclusion]) -> str:
    reasons = {one.node: one.reason for one in exclusions}
    if preferred not in reasons:
        return "preferred unknown"
    gone = reasons[preferred] in (UNAVAILABLE, "stale", "draining")
    return "preferred unavailable" if gone else f"preferred excluded: {reasons[preferred]}"
