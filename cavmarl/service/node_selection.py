"""Which node serves a session: reasons against nodes, then eq. (1) and (2) of `balance`.

Beside a node's load count its slots, its capabilities, the identities that it serves and the age of
what is known of it. A session that a node was given since its last beat is not in the load that it
tells: it counts as one slot's share of the processor, so that requests which come at once do not
all go to the node that was idle a second ago. That share excludes no node.
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


class Exclusion(NamedTuple):
    """Why a node is not chosen."""

    node: str
    reason: str  # unavailable, stale, draining, capacity, capability, access, cpu, ram, gpu
    value: float | None = None
    threshold: float | None = None


@dataclass
class LiveNode:
    """What is known of a node beside the log: its last beat.

    Attributes:
        number: by which ties are broken: the order of registration.
    """

    number: int
    heard_s: float  # when it was heard of last, by the service's clock
    beat: int = -1  # sequence number of its last beat
    use: Utilisation | None = None  # None: no beat yet
    hosted: set[str] = field(default_factory=set)  # ids of sessions that are assigned to it
    muted: set[str] = field(default_factory=set)  # of these, since its last beat
    zones_of: list[str] = field(default_factory=list)  # sessions, a time for each part that it has
    counters: dict[str, float] = field(default_factory=dict)  # that it tells for /metrics
    jobs: dict[str, list[int]] = field(default_factory=dict)  # steps done, and to be, of its jobs
    candidate: Candidate | None = None  # as `select` takes it; None: to be made

    def refresh(self) -> None:
        """Something has changed that its candidate is made of."""
        self.candidate = None


class Chosen(NamedTuple):
    """The node that a session gets."""

    node: str
    outcome: str  # why it is this one, as `balance.load_score.Outcome`, or `preferred unknown`
    score: float
    exclusions: tuple[Exclusion, ...]


class NoNodeError(ServiceError):
    """No node can take a session now.

    Attributes:
        exclusions: why each is not chosen.
    """

    def __init__(self, exclusions: tuple[Exclusion, ...]) -> None:
        counts: dict[str, int] = {}
        for one in exclusions:
            counts[one.reason] = counts.get(one.reason, 0) + 1
        said = ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items()))
        super().__init__(
            f"no node can take this ({said or 'none is registered'}); try again later, ask with "
            "wait_s, or start one: cavmarl node --service URL",
            503,
            "no-node",
        )
        self.exclusions = exclusions


def choose(
    nodes: Mapping[str, NodeRecord],
    live: Mapping[str, LiveNode],
    session: SessionRecord,
    *,
    now_s: float,
    max_age_s: float,  # of a node's last beat
    avoided: Sequence[str] = (),  # nodes that the client cannot reach
    rule: LoadRule = DEFAULT_RULE,
) -> Chosen:
    """The admissible node of the lowest score, or the preferred one if it is about as good.

    Raises:
        NoNodeError: all are excluded.
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


def overloads(use: Utilisation, rule: LoadRule = DEFAULT_RULE) -> list[str]:
    """The resources that are above their thresholds."""
    return [one.resource for one in find_rejections([Candidate(0, use)], rule)]


def score_of(node: NodeRecord, known: LiveNode, rule: LoadRule = DEFAULT_RULE) -> float | None:
    """LoadScore of a node as selection sees it; None: it has told no load."""
    if known.use is None:
        return None
    return load_score(_candidate(node, known, rule).use, rule.weights)


def _reason_against(
    node: NodeRecord, known: LiveNode, session: SessionRecord, is_old: bool
) -> str | None:
    """The first reason, but for load, why a node cannot take a session."""
    if node.state != "up":
        return UNAVAILABLE
    if is_old or known.use is None:
        return "stale"
    if node.draining:
        return "draining"
    if node.allowed and session.owner_name not in node.allowed:
        return "access"
    if session.needs and not set(session.needs) <= set(node.capabilities):
        return "capability"
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
