"""Check that divided worlds equal the undivided world, step by step.

All worlds use the public interface, with the same seed and separate drivers. After every step, the
hashes of all worlds and all results of `step` are compared. If another simulator with a tolerance
runs a zone of a world, the world is run, but not compared.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.checks import check_count
from cavmarl.config.world_spec import WorldKeys, WorldSpec
from cavmarl.config.zones import MAX_ZONES, ZONE_FILE_SUFFIXES
from cavmarl.core.errors import ConfigError, ProtocolError, ZoneSimulatorError
from cavmarl.env.vector import make_vec
from cavmarl.handoff.simulators.simulator_kinds import hosted_zones
from cavmarl.verify.determinism import MAX_STEPS
from cavmarl.verify.differences import Difference, DrivenRun, find_difference, same_bytes, snapshot
from cavmarl.zones.kernels.zone_lookup import zones_of
from cavmarl.zones.partition.zone_file import read_zones

ZONES = (1, 2, 4, 9)


@dataclass(frozen=True)
class ZoneResult:
    """The result for one number of zones."""

    zones: int  # number of zones
    steps: int  # number of compared steps
    crossings: int  # vehicles that changed their zone, summed over steps and worlds
    vehicles: float  # number of vehicles in all worlds, averaged over the steps
    world: int | None  # the first world that differs; None if all were equal
    difference: Difference | None  # the difference in this world; None if all were equal
    # the largest tolerance of a simulator of a zone, see `register_zone_simulator`; if it is above
    # 0, the worlds are not compared
    tolerance_m: float = 0.0


@dataclass(frozen=True)
class Equivalence:
    """The result of `verify_zones`."""

    env: str  # name of the environment
    worlds: int  # number of worlds stepped together
    steps: int  # number of requested steps
    ticks: int  # ticks of the first world's episode at the end
    state_hashes: tuple[str, ...]  # hashes of the undivided worlds at the end
    results: tuple[ZoneResult, ...]  # one for each number of zones

    @property
    def holds(self) -> bool:
        return all(result.difference is None for result in self.results)

    def to_dict(self) -> dict[str, Any]:
        return {**asdict(self), "holds": self.holds}


def verify_zones(
    env: str | Path | WorldSpec,
    zones: Sequence[int] | None = None,
    *,
    steps: int = 200,
    layout: str | Path | None = None,
    policy: str | Path = "idm",
    worlds: int = 1,
    check: bool = False,
    journals: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    **keys: Unpack[WorldKeys],
) -> Equivalence:
    """Compare divided worlds with undivided worlds after each step.

    Args:
        env: see `make_vec`, also for keywords that are not explained here.
        zones: numbers of zones; default: the number in the zone file, otherwise `ZONES`.
        steps: number of steps; episodes follow one another.
        layout: replaces zones.layout; the path of a zone file is relative to the working directory.
        policy: as in `load_policy`; it has the same seed as the worlds.
        worlds: number of worlds stepped together.
        check: whether to check the invariants of ownership in the divided worlds.
        journals: folder for the journals of the divided worlds, one for each number of zones.
        progress: called after each step with its number and `steps`.
        keys: settings of the worlds; overrides of `zones` apply to the divided worlds only.

    Raises:
        ConfigError: a number or a key is invalid, the map cannot hold this many zones, or a zone
            file has a different number of zones.
        JournalError: a journal cannot be created.
        PolicyError: the policy cannot be loaded or does not fit.
    """
    check_count("steps", steps, MAX_STEPS)
    spec = WorldSpec.of(env, **keys)
    divided = _divided(spec, layout, check)
    plain = {key: value for key, value in divided.items() if not key.startswith("zones.")}

    with ExitStack() as opened:

        def run(count: int, settings: Mapping[str, Any]) -> DrivenRun:
            wanted = spec.keywords | {"overrides": settings}
            vec = make_vec(spec.env, num_envs=worlds, zones=count, **wanted)
            opened.callback(vec.close)
            return DrivenRun(vec, policy, spec.seed)

        whole = run(1, plain)
        compared = [
            _Compared(run(count, divided | _journal(journals, count) if count > 1 else plain))
            for count in _counts(zones, divided)
        ]
        for step in range(steps + 1):
            if step > 0:
                whole.step()
            for other in compared:
                other.follow(step, whole)
            if progress is not None:
                progress(step, steps)
            if all(other.difference is not None for other in compared):
                break
        ticks = int(whole.vec.simulation.ticks()[0])
        hashes = tuple(whole.vec.state_hash(w) for w in range(worlds))
        results = tuple(other.result() for other in compared)
    return Equivalence(spec.env, worlds, steps, ticks, hashes, results)


def _divided(spec: WorldSpec, layout: str | Path | None, check: bool) -> dict[str, Any]:
    settings = dict(spec.overrides)
    if layout is not None:
        if "zones.layout" in settings:
            raise ConfigError(
                "zones.layout is set both by overrides and by layout; use only one of them"
            )
        settings["zones.layout"] = _layout(str(layout))
    return settings | ({"zones.check_invariants": True} if check else {})


def _journal(folder: Path | None, count: int) -> dict[str, str]:
    if folder is None:
        return {}
    return {"zones.journal": str(folder / f"zones-{count}.jsonl")}


def _layout(path: str) -> str:
    return str(Path(path).resolve()) if path.endswith(ZONE_FILE_SUFFIXES) else path


def _counts(zones: Sequence[int] | None, settings: Mapping[str, Any]) -> list[int]:
    """Return the distinct numbers of zones. Raises ConfigError if one is invalid."""
    if zones is None:
        layout = str(settings.get("zones.layout", ""))
        zones = (read_zones(layout).count,) if layout.endswith(ZONE_FILE_SUFFIXES) else ZONES
    for count in zones:
        if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= MAX_ZONES:
            raise ConfigError(f"zones = {count!r}: must be whole numbers from 1 to {MAX_ZONES}")
    if not zones:
        raise ConfigError("zones is empty; use at least one number of zones")
    return list(dict.fromkeys(zones))


class _Compared:
    """Divided worlds that are compared with undivided worlds up to the first difference."""

    def __init__(self, run: DrivenRun) -> None:
        self._run = run
        self._steps = 0
        self._crossings = 0
        self._vehicles = 0
        self._zones: list[dict[int, int]] = [{} for _ in range(run.vec.num_envs)]
        self._world: int | None = None
        config = run.vec.config
        hosted = hosted_zones(config.zones.simulators, run.vec.simulation.partition.count)
        self._tolerance_m = max((one.tolerance_m for one in hosted), default=0.0)
        self.difference: Difference | None = None

    def follow(self, step: int, whole: DrivenRun) -> None:
        """Take the same step as the undivided worlds, and compare."""
        if self.difference is not None:
            return
        try:
            if step > 0:
                self._run.step()
        except (ProtocolError, ConfigError, ZoneSimulatorError) as error:
            tick = int(whole.vec.simulation.ticks()[0])
            self._world = 0
            self.difference = Difference(step, tick, "error", None, "", (None, str(error)))
            return
        self._steps = step
        self._count_crossings()
        if self._tolerance_m == 0.0:
            self._compare(step, whole)

    def result(self) -> ZoneResult:
        simulation = self._run.vec.simulation
        return ZoneResult(
            simulation.partition.count,
            self._steps,
            self._crossings,
            self._vehicles / (self._steps + 1),
            self._world,
            self.difference,
            self._tolerance_m,
        )

    def _compare(self, step: int, whole: DrivenRun) -> None:
        mine, theirs = self._run, whole
        same = same_bytes(theirs.results, mine.results)
        for w in range(mine.vec.num_envs):
            if same and mine.vec.state_hash(w) == theirs.vec.state_hash(w):
                continue
            states = [snapshot(run.vec, run.results, w) for run in (theirs, mine)]
            tick = int(theirs.vec.simulation.ticks()[w])
            found = find_difference(step, tick, *states)
            if found.what == "hidden state" and (
                mine.vec.state_hash(w) == theirs.vec.state_hash(w)
            ):
                continue  # the results of another world differ
            self._world, self.difference = w, found
            return

    def _count_crossings(self) -> None:
        simulation = self._run.vec.simulation
        for w, before in enumerate(self._zones):
            rows = simulation.vehicles(w)
            zones: NDArray[np.int32] = np.empty(len(rows), dtype=np.int32)
            zones_of(simulation.partition.arrays, rows, len(rows), zones)
            now = dict(zip(rows["id"].tolist(), zones.tolist(), strict=True))
            self._vehicles += len(rows)
            self._crossings += sum(
                zone != before.get(vehicle, zone) for vehicle, zone in now.items()
            )
            self._zones[w] = now
