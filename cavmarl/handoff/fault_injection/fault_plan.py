"""`Faults`: a plan of what is done to a run on purpose, and how it is read from JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

from cavmarl.core.errors import ConfigError
from cavmarl.ownership.transport import FaultPlan, Rates, check_rate, check_whole
from cavmarl.shards import phases

MESSAGES = ("Step", "Done", "Prepare", "Ack", "Nack", "Abort", "Need")
PHASES = tuple(name for name, rule in phases.PHASES.items() if rule.may_die)
ZONE_POINTS = (
    "PREPARE arrives", "ACK sent", "STEP arrives", "lease taken", *PHASES, "before DONE",
)  # fmt: skip
COORDINATOR_POINTS = (
    "offers made", "BEGIN torn", "BEGIN written", "STEP sent", *PHASES, "all done",
    "COMMIT torn", "COMMIT written",
)  # fmt: skip


@dataclass(frozen=True)
class Crash:
    """One death of a process.

    Attributes:
        tick: which the world is on its way to; the run's, which never begins anew.
        point: of the tick, in ZONE_POINTS or COORDINATOR_POINTS.
        zone: the zone of the host that dies; None: the coordinator.
        lives_on: it only hangs, is given up, and goes on with what it was doing.
        times: how often it dies there, each new host again; of a zone.
    """

    tick: int
    point: str
    zone: int | None = None
    lives_on: bool = False
    times: int = 1

    def __post_init__(self) -> None:
        points = COORDINATOR_POINTS if self.zone is None else ZONE_POINTS
        if self.point not in points:
            what = "the coordinator" if self.zone is None else "a zone"
            raise ConfigError(
                f"{what} cannot die at '{self.point}'; points are {', '.join(points)}"
            )
        check_whole("the tick of a crash", self.tick, 0)
        check_whole("times of a crash", self.times, 1)
        if self.zone is not None:
            check_whole("the zone of a crash", self.zone, 0)
        if not isinstance(self.lives_on, bool):
            raise ConfigError(f"lives_on = {self.lives_on!r}: must be true or false")


@dataclass(frozen=True)
class Faults:
    """A plan.

    Attributes:
        seed: of all that is drawn.
        messages: kind → rates of its faults.
        crashes: those that are named.
        crash_rate: probability that a party dies at a point of a tick, beside those.
        until: the first tick of the run on the way to which nothing happens any more; None: never.
    """

    seed: int = 0
    messages: Mapping[str, Rates] = field(default_factory=dict)
    crashes: tuple[Crash, ...] = ()
    crash_rate: float = 0.0
    until: int | None = None

    def __post_init__(self) -> None:
        unknown = sorted(set(self.messages) - set(MESSAGES))
        if unknown:
            raise ConfigError(f"messages {unknown} are none of {', '.join(MESSAGES)}")
        check_whole("seed", self.seed, 0)
        check_rate("crash_rate", self.crash_rate, 0.1)
        if self.until is not None:
            check_whole("until", self.until, 0)
            late = [crash for crash in self.crashes if crash.tick >= self.until]
            if late:
                raise ConfigError(
                    f"a process dies in tick {late[0].tick}, and nothing happens from tick "
                    f"{self.until} on (until); take one of them away"
                )
        for kind in ("Step", "Done"):
            rates = self.messages.get(kind, Rates())
            if rates.drop + rates.corrupt > 0.95:
                raise ConfigError(
                    f"{kind} has to arrive now and then; drop and corrupt it in at most "
                    "95 of 100 cases"
                )

    @property
    def may_crash(self) -> bool:
        return bool(self.crashes) or self.crash_rate > 0.0

    def check_zones(self, count: int) -> None:
        """See that the zones whose hosts die are there."""
        for crash in self.crashes:
            if crash.zone is not None and crash.zone >= count:
                raise ConfigError(
                    f"faults: the host of zone {crash.zone} cannot die, there are {count} zones; "
                    f"name one from 0 to {count - 1}"
                )

    def plan(self) -> FaultPlan:
        return FaultPlan(self.seed, self.messages, until_tick=self.until)

    def to_json(self) -> str:
        """The plan as `read_faults` takes it."""
        return json.dumps(asdict(self))


def read_faults(text: str) -> Faults:
    """A plan from JSON, or from a file of it; docs/faults.md says what stands in it."""
    where = "faults"
    if not text.lstrip().startswith("{"):
        where = f"faults {text}"
        try:
            text = Path(text).read_text(encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"{where}: {error.strerror}; name a file of JSON") from None
        except ValueError as error:
            raise ConfigError(f"{where}: {error}; name a file of JSON") from None
    try:
        content: Any = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{where}: no JSON: {error}") from None
    return _faults(where, content)


Made = TypeVar("Made", Crash, Faults, Rates)


def _faults(where: str, content: Any) -> Faults:
    known = _object(where, content, Faults)
    rates, crashes = known.pop("messages", {}), known.pop("crashes", [])
    if not isinstance(rates, dict):
        raise ConfigError(f"{where}, messages: must be an object, kind by kind")
    if not isinstance(crashes, list):
        raise ConfigError(f"{where}, crashes: must be a list of objects")
    messages = {
        kind: _made(f"{where}, messages, {kind}", entry, Rates) for kind, entry in rates.items()
    }
    deaths = [
        _made(f"{where}, crashes[{number}]", entry, Crash) for number, entry in enumerate(crashes)
    ]
    return _placed(where, Faults, known | {"messages": messages, "crashes": tuple(deaths)})


def _made(where: str, content: Any, kind: type[Made]) -> Made:
    return _placed(where, kind, _object(where, content, kind))


def _object(where: str, content: Any, kind: type[Any]) -> dict[str, Any]:
    names = [entry.name for entry in fields(kind)]
    if not isinstance(content, dict):
        raise ConfigError(f"{where}: must be an object of {', '.join(names)}")
    unknown = sorted(set(content) - set(names))
    if unknown:
        raise ConfigError(f"{where}: no key {', '.join(unknown)}; there are {', '.join(names)}")
    missing = sorted({"tick", "point"} - set(content)) if kind is Crash else []
    if missing:
        raise ConfigError(f"{where}: needs {', '.join(missing)}")
    return dict(content)


def _placed(where: str, kind: type[Made], values: dict[str, Any]) -> Made:
    try:
        return kind(**values)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None
