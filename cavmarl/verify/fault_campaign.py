"""A campaign of faults: groups of runs (lines), and the totals of each group."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Generic, TypeVar

from cavmarl.core.errors import ConfigError


@dataclass
class FaultLine:
    """The runs with one number of nodes and one kind of fault."""

    nodes: int  # number of nodes at the start
    kind: str  # kind of the faults, or name of a mix of kinds
    runs: int = 0  # number of runs
    deaths: int = 0  # number of processes that faults have ended
    lost: int = 0  # number of lost nodes
    recoveries: int = 0  # number of rollbacks to an earlier state
    equal: int = 0  # runs that equalled the undivided world until the end
    ended: int = 0  # runs that ended with `WorkerDeathError`: a part of the state was lost
    injected: Counter[str] = field(default_factory=Counter)  # number of faults, by kind
    wrong: list[str] = field(default_factory=list)  # descriptions of all other runs
    wrong_seeds: list[int] = field(default_factory=list)  # seeds of the runs in `wrong`

    def to_dict(self) -> dict[str, Any]:
        return {**vars(self), "injected": _by_kind(self.injected)}


Line = TypeVar("Line", bound=FaultLine)


@dataclass(frozen=True)
class FaultCampaign(Generic[Line]):
    """The result of a campaign."""

    env: str  # name of the environment
    zones: int  # number of zones of each world
    steps: int  # minimum number of steps of each run
    lines: tuple[Line, ...]  # one for each number of nodes and kind of fault

    @property
    def holds(self) -> bool:
        return not any(line.wrong for line in self.lines)

    def to_dict(self) -> dict[str, Any]:
        numbers = [one.name for one in fields(self.lines[0]) if one.type == "int"][1:]
        injected = sum((line.injected for line in self.lines), Counter[str]())
        return {
            "env": self.env,
            "zones": self.zones,
            "steps": self.steps,
            "faults": injected.total(),
            "injected": _by_kind(injected),
            **{name: sum(getattr(line, name) for line in self.lines) for name in numbers},
            "wrong": sum(len(line.wrong) for line in self.lines),
            "lines": [line.to_dict() for line in self.lines],
            "holds": self.holds,
        }


def run_lines(
    lines: Sequence[Line],
    seeds: range,
    run: Callable[[Line, int], None],  # does one run of a line with a seed
    progress: Callable[[int, int], None] | None,  # called with completed runs and all runs
) -> None:
    """Do one run for each line and each seed."""
    for n, line in enumerate(lines):
        for k, seed in enumerate(seeds, start=1):
            line.runs += 1
            run(line, seed)
            if progress is not None:
                progress(n * len(seeds) + k, len(lines) * len(seeds))


def check_nodes(nodes: Sequence[int]) -> None:
    """Raise ConfigError unless `nodes` are one or more numbers of nodes."""
    if not nodes or min(nodes) < 1:
        raise ConfigError(f"nodes = {list(nodes)}: must be one or more numbers from 1 on")


def check_kinds(name: str, given: Sequence[str], known: Sequence[str]) -> None:
    """Raise ConfigError unless all given kinds of faults are known."""
    if unknown := [kind for kind in given if kind not in known]:
        raise ConfigError(f"{name} = {unknown}: must be among {', '.join(known)}")


def _by_kind(counts: Counter[str]) -> dict[str, int]:
    """Return the counts of kinds that have happened, the most frequent kind first."""
    return {str(kind): count for kind, count in counts.most_common() if count}
