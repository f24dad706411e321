"""A suite: the same policies, or controllers of signals, on several maps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from cavmarl.config.io import read_yaml, validate
from cavmarl.config.registry import entries
from cavmarl.core.errors import ConfigError
from cavmarl.evaluate.evaluation import evaluate
from cavmarl.evaluate.report import EvaluationReport
from cavmarl.evaluate.signals.signal_meter import SignalFigures
from cavmarl.evaluate.signals.signal_runs import TICK_S, run_controller, run_sumo
from cavmarl.evaluate.traffic.sumo_side import SumoJob
from cavmarl.maps.netconvert import map_file
from cavmarl.parallel.placement.backend_name import LOCAL
from cavmarl.traffic.sumo.sumo_input import read_input

SUMO = "SUMO"  # name of the row of results from SUMO itself, with the map's own signal programs


@dataclass(frozen=True)
class Suite:
    """The worlds of a suite: every map with every number of agents.

    Values that are left out are as configured by each environment.
    """

    maps: tuple[str, ...]  # names of environments, or map files in the folder of maps
    agents: tuple[int, ...] | None = None  # numbers of agents
    background: int | None = None  # background vehicles of every world
    horizon_s: float | None = None  # horizon of every episode
    # controllers of all signals, see `run_controller`; None: the suite evaluates policies
    controllers: tuple[str, ...] | None = None
    more_maps: tuple[str, ...] = ()  # maps that are left out if the folder does not have them

    def __post_init__(self) -> None:
        for name in ("maps", "agents", "controllers"):
            values = getattr(self, name)
            if values is not None and (not values or len(set(values)) < len(values)):
                raise ConfigError(
                    f"{name} = {values!r}: must not be empty or contain a value twice"
                )


@dataclass(frozen=True)
class SuiteWorld:
    """One world of a suite."""

    label: str  # name in results, and name of the folder
    env: str  # as in `make_vec`
    agents: int | None  # number of agents; None: as configured by the environment


def load_suite(path: Path) -> Suite:
    return validate(Suite, read_yaml(path), str(path))


def worlds_of(suite: Suite, maps: Path) -> list[SuiteWorld]:
    listed = [*_found(suite, maps)]
    names = [Path(name).name for name, _ in listed]
    stems = [name.partition(".")[0] for name in names]
    found = {  # an environment and a file may have the same stem
        stem if stems.count(stem) == 1 else name: env
        for stem, name, (_, env) in zip(stems, names, listed, strict=True)
    }
    if len(found) < len(listed):
        raise ConfigError(f"maps = {suite.maps!r}: two maps have the same name; rename a file")
    if suite.agents is None:
        return [SuiteWorld(name, env, None) for name, env in found.items()]
    return [
        SuiteWorld(f"{name}-{agents}", env, agents)
        for name, env in found.items()
        for agents in suite.agents
    ]


def _found(suite: Suite, maps: Path) -> Iterator[tuple[str, str]]:
    known = entries()
    for name in suite.maps:
        if name in known:
            yield name, name
        elif (maps / name).is_file():
            yield name, str(maps / name)
        else:
            raise ConfigError(
                f"maps: '{name}' is no environment and no file in {maps}: give the folder of the "
                "maps with --maps, or a suite of your own"
            )
    for name in suite.more_maps:
        if (maps / name).is_file():
            yield name, str(maps / name)


def left_out(suite: Suite, maps: Path) -> tuple[str, ...]:
    """Return the `more_maps` that are not in the folder."""
    return tuple(name for name in suite.more_maps if not (maps / name).is_file())


def run_suite(
    suite: Suite,
    worlds: Sequence[SuiteWorld],
    policies: Sequence[str],
    out: Path,
    *,
    episodes: int,
    repeats: int,
    seed: int,
    began: Callable[[SuiteWorld], None],
    overrides: Mapping[str, object] | None = None,
    zones: int | None = None,
    backend: str = LOCAL,
) -> dict[str, EvaluationReport]:
    """Evaluate the policies in every world, each in its own folder in `out`.

    If the suite sets the number of agents, an agent whose trip ends gets a new vehicle (`respawn`),
    so that the number of vehicles stays the same. `began` is called before each world. `overrides`
    are values of further keys of every world. Policies, episodes, repeats, seed, zones and backend
    are as in `evaluate`.
    """
    reports = {}
    keys: dict[str, object] = {}
    if suite.agents is not None:
        keys["population.mode"] = "respawn"
    if suite.horizon_s is not None:
        keys["horizon_s"] = suite.horizon_s
    keys |= overrides or {}
    for world in worlds:
        began(world)
        reports[world.label] = evaluate(
            world.env,
            policies,
            episodes=episodes,
            repeats=repeats,
            seed=seed,
            out=out / world.label,
            agents=world.agents,
            background=suite.background,
            overrides=keys,
            zones=zones,
            backend=backend,
        )
    return reports


def run_signals(
    suite: Suite,
    worlds: Sequence[SuiteWorld],
    *,
    repeats: int,
    seed: int,
    began: Callable[[SuiteWorld], None],
    overrides: Mapping[str, object] | None = None,
) -> dict[str, dict[str, list[SignalFigures]]]:
    """Run each controller of signals in every world, and also SUMO if the map is a .sumocfg.

    Args:
        suite: has `controllers`.
        worlds: its worlds.
        repeats: number of runs, with the seeds `seed`, `seed` + 1, ….
        seed: first seed.
        began: called before each world.
        overrides: values of further keys of every world.

    Returns:
        For each world and each controller, the figures of all runs.
    """
    seconds = round(suite.horizon_s or 3600.0)
    seeds = range(seed, seed + repeats)
    keys: dict[str, object] = {"population.mode": "open", **(overrides or {})}
    found: dict[str, dict[str, list[SignalFigures]]] = {}
    for world in worlds:
        began(world)
        own = dict(keys)
        is_sumo = world.env.endswith(".sumocfg")
        if suite.background is not None or is_sumo:
            own.setdefault("population.background", 0 if is_sumo else suite.background)
        figures = {
            controller: run_controller(
                world.env, controller, seconds=seconds, seeds=seeds, overrides=own
            )
            for controller in suite.controllers or ()
        }
        if is_sumo:
            demand = read_input([Path(world.env)])
            job = SumoJob(map_file(world.env), demand, seconds, TICK_S, seed)
            figures[SUMO] = [run_sumo(replace(job, seed=number)) for number in seeds]
        found[world.label] = figures
    return found
