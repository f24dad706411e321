"""The lines of the fault matrix, and the plans that each is made of.

The processes to kill come from a run without faults (`Rehearsal`): in the tick of a hand-over its
source, its target, or a bystander. So every point is met by every party, and none by chance.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from cavmarl.handoff.fault_injection.fault_plan import (
    COORDINATOR_POINTS,
    MESSAGES,
    ZONE_POINTS,
    Crash,
    Faults,
)
from cavmarl.handoff.fault_injection.injected_faults import Visit
from cavmarl.ownership.messages import COORDINATOR
from cavmarl.ownership.transport import Rates

ROLES = ("source", "target", "bystander")
APART = 6  # ticks between two deaths of a run, so that each meets a settled world
HAND_OVER = ("Prepare", "Ack", "Nack", "Abort", "Need")
LOSS = (0.01, 0.1, 0.5, 1.0)
LATEST = (1, 8, 64)  # phases that a message is late
MANY = 5  # so often a tick of which every host dies is begun

ELSEWHERE = (
    ("SIGKILL or SIGSTOP of a process, slow workers, hangs", "verify --kill, docs/workers.md"),
    ("memory, descriptors or /dev/shm used up; clock jumps", "worker processes"),
    ("a zone moved to another worker, LoadScore readings", "worker processes"),
    ("disk full, damaged and torn files", "tests/handoff/test_journal.py"),
    ("messages of another run, wrong zone, truncated", "tests/ownership"),
    ("wild write into foreign rows", "tests/handoff/test_committed_store.py"),
    ("crossings, corners, thin zones, removals, id collisions", "tests/ownership, tests/test_*"),
    ("hostile input to the interface", "tests/test_bad_input.py"),
)
"""Lines of the matrix that are shown somewhere else, and where."""

Option = tuple[Crash, ...]
"""Deaths in one tick."""


@dataclass(frozen=True)
class Rehearsal:
    """What a divided run without faults came to."""

    zones: int  # how many
    ticks: int  # of the run
    visits: frozenset[Visit]  # zones at each point in each tick
    switches: tuple[tuple[int, int, int], ...]  # (tick, source, target) of each hand-over

    def meet(self, point: str, role: str) -> list[tuple[int, int]]:
        """(tick, zone) in which a zone of that role in a hand-over is at a point."""
        found = []
        for tick in sorted({tick for tick, _, _ in self.switches}):
            parts = {
                "source": {source for at, source, _ in self.switches if at == tick},
                "target": {target for at, _, target in self.switches if at == tick},
            }
            parts["bystander"] = set(range(self.zones)) - parts["source"] - parts["target"]
            found += [(tick, z) for z in sorted(parts[role]) if (tick, point, z) in self.visits]
        return found

    def together(self, point: str) -> list[tuple[int, list[int]]]:
        """(tick, all zones at the point) where they are several; first where they are most."""
        found: dict[int, list[int]] = {}
        for tick, at, party in sorted(self.visits):
            if at == point and party != COORDINATOR:
                found.setdefault(tick, []).append(party)
        several = [(tick, zones) for tick, zones in found.items() if len(zones) > 1]
        return sorted(several, key=lambda entry: (-len(entry[1]), entry[0]))

    def coordinator_at(self, point: str) -> list[int]:
        """Ticks of hand-overs in which the coordinator is at a point."""
        switching = {tick for tick, _, _ in self.switches}
        return sorted(t for t in switching if (t, point, COORDINATOR) in self.visits)


@dataclass(frozen=True)
class MatrixLine:
    """A line of the matrix."""

    name: str  # what happens
    points: str  # where, or how often
    plans: tuple[Faults, ...]  # one a run
    unmet: tuple[str, ...] = ()  # points that no run reached in that role
    poison: bool = False  # whether it has to end in `LostTickError`


def matrix(seen: Rehearsal, seed: int, seeds: int) -> list[MatrixLine]:
    """All lines that apply to one process."""
    return [*_host_lines(seen), *_coordinator_lines(seen), *_message_lines(seed, seen.ticks),
            _random_line(seed, seeds)]  # fmt: skip


# Deaths


def _host_lines(seen: Rehearsal) -> list[MatrixLine]:
    once = {role: _cases(seen, role, Crash(0, ZONE_POINTS[0], 0)) for role in ROLES}
    lines = [_line(f"the {role}'s host dies", cases) for role, cases in once.items()]
    twice, thrice = (replace(Crash(0, ZONE_POINTS[0], 0), times=times) for times in (2, 3))
    lives = replace(twice, lives_on=True, times=1)
    for name, crash in (
        ("the new host dies, too", twice),
        ("three hosts die in a row", thrice),
        ("a host is given up, and lives on", lives),
    ):
        lines.append(_line(name, [case for role in ROLES for case in _cases(seen, role, crash)]))
    everybody = [
        (point, [tuple(Crash(t, point, z) for z in zones) for t, zones in seen.together(point)])
        for point in ZONE_POINTS
    ]
    lines.append(_line("all hosts die that come to a point", everybody))
    poison = _line("every host of a zone dies", _cases(seen, "target", replace(twice, times=MANY)))
    alone = [Faults(crashes=(crash,)) for plan in poison.plans for crash in plan.crashes]
    lines.append(replace(poison, plans=tuple(alone), poison=True))
    return lines


def _cases(seen: Rehearsal, role: str, like: Crash) -> list[tuple[str, list[Option]]]:
    """Of each point its name, and the deaths there that can be had."""
    return [
        (
            f"{point} ({role})",
            [(replace(like, tick=t, point=point, zone=z),) for t, z in seen.meet(point, role)],
        )
        for point in ZONE_POINTS
    ]


def _coordinator_lines(seen: Rehearsal) -> list[MatrixLine]:
    def cases(points: Iterable[str], times: int) -> list[tuple[str, list[Option]]]:
        return [
            (
                f"{point} (coordinator)",
                [(Crash(t, point, None, False, times),) for t in seen.coordinator_at(point)],
            )
            for point in points
        ]  # fmt: skip

    torn = [point for point in COORDINATOR_POINTS if point.endswith("torn")]
    written = [point for point in COORDINATOR_POINTS if point.endswith("written")]
    again = [point for point in COORDINATOR_POINTS if point not in written]
    every = tuple(
        Crash(tick, point) for tick in range(1, seen.ticks // 3 + 1) for point in (*torn, *written)
    )
    return [
        _line("the coordinator dies", cases(COORDINATOR_POINTS, 1)),
        _line("the next coordinator dies, too", cases(again, 2)),
        MatrixLine("the coordinator restarts at every record", "each of a third of the run",
             (Faults(crashes=every),)),
    ]  # fmt: skip


def _line(name: str, cases: Sequence[tuple[str, list[Option]]]) -> MatrixLine:
    """Put the cases into as few runs as they go into, apart from each other."""
    runs: list[list[Crash]] = []
    for _, options in cases:
        if options and not any(_put(run, options) for run in runs):
            runs.append(list(options[0]))
    unmet = tuple(label for label, options in cases if not options)
    plans = tuple(Faults(crashes=tuple(sorted(run, key=lambda c: c.tick))) for run in runs)
    return MatrixLine(name, f"{len(cases) - len(unmet)} points", plans, unmet)


def _put(run: list[Crash], options: Iterable[Option]) -> bool:
    for option in options:
        if all(abs(option[0].tick - crash.tick) >= APART for crash in run):
            run += option
            return True
    return False


# Messages


def _message_lines(seed: int, ticks: int) -> list[MatrixLine]:
    def line(name: str, points: str, *messages: dict[str, Rates]) -> MatrixLine:
        return MatrixLine(name, points, tuple(Faults(seed, rates) for rates in messages))

    def rates(**values: float) -> dict[str, Rates]:
        return {kind: Rates(**values) for kind in HAND_OVER}  # type: ignore[arg-type]

    losses = "1, 10, 50, 100 %"
    late = ", ".join(map(str, LATEST))
    refused = Rates(refuse=0.3)
    heavy = {kind: Rates(0.3, 0.3, 0.3, 0.3, 0.05, 0.2) for kind in HAND_OVER}
    return [
        line("PREPARE is lost", losses, *({"Prepare": Rates(drop=r)} for r in LOSS)),
        line("ACK is lost", losses, *({"Ack": Rates(drop=r)} for r in LOSS)),
        line("ABORT is lost", losses, *({"Abort": Rates(drop=r)} for r in LOSS)),
        line("NACK is lost", f"{losses} of those at 30 % refusals",
             *({"Prepare": refused, "Nack": Rates(drop=r)} for r in LOSS)),
        line("NACK for load", "10, 50, 100 % of the offers",
             *({"Prepare": Rates(refuse=r)} for r in LOSS[1:])),
        line("messages of hand-overs come twice", f"again 1 to {late} phases later",
             *(rates(duplicate=1.0, longest_delay=n) for n in LATEST)),
        line("messages of hand-overs come late", f"half of them, 1 to {late} phases",
             *(rates(delay=0.5, longest_delay=n) for n in LATEST)),
        line("messages of hand-overs change places", "all", rates(reorder=1.0)),
        line("a bit flips on the way", "30 % of all", {k: Rates(corrupt=0.3) for k in MESSAGES}),
        line("STEP and DONE are lost", "10, 50, 90 %",
             *({k: Rates(drop=r) for k in ("Step", "Done")} for r in (0.1, 0.5, 0.9))),
        line("STEP and DONE come twice, late, in another order", "half of them", {
            k: Rates(delay=0.5, duplicate=0.5, reorder=0.5) for k in ("Step", "Done")}),
        MatrixLine("all of it, healed half way", "open hand-overs end within D + 2 ticks",
             (Faults(seed, heavy, until=ticks // 2),)),
    ]  # fmt: skip


def _random_line(seed: int, seeds: int) -> MatrixLine:
    messages = {kind: Rates(0.1, 0.1, 0.1, 0.1, 0.05) for kind in MESSAGES}
    messages["Prepare"] = replace(messages["Prepare"], refuse=0.1)
    plans = tuple(Faults(seed + k, messages, crash_rate=0.001) for k in range(seeds))
    return MatrixLine("any process at any time, and messages", f"{seeds} seeds", plans)
