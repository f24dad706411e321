"""`SignalWorld`: the world of a `SumoEnvironment`, with counts of vehicles near its signals."""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import quote
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.registry import load_config
from cavmarl.config.signals import SignalsConfig
from cavmarl.core.errors import ConfigError, DemandError, MapError
from cavmarl.core.seeds import first_seed
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import make_world
from cavmarl.env.drawn_worlds import RENDER_MODES, check_rendering
from cavmarl.parallel.backends import find_backend
from cavmarl.render.topdown import WorldView
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.sumo_options import known_options
from cavmarl.shards.shard import Commands
from cavmarl.signals.agent_programs import with_agent_programs
from cavmarl.signals.kernels.green_choices import GREEN, KEEP, PREVIOUS, SINCE
from cavmarl.signals.kernels.lane_counts import (
    COUNTS,
    LENGTH_MM,
    SPEED_PPM,
    STANDING,
    STANDING_MPS,
    STOOD_TICKS,
    VEHICLES,
)
from cavmarl.signals.signal_table import SignalTable

TICK_S = 0.2
_MOST_STEP_S = 1.0  # step of worlds whose signals follow their programs; SUMO's step


@dataclass(frozen=True)
class WorldSettings:
    """The arguments of a `SumoEnvironment` that its world depends on; times are in s."""

    net_file: str
    route_file: str  # one or several files, separated by commas
    begin_s: float
    horizon_s: float
    decide_s: float
    yellow_s: float
    min_green_s: float
    follows_programs: bool  # signals follow their programs instead of choices
    sumo_options: str  # options of SUMO's command line
    render_mode: str | None
    overrides: Mapping[str, Any]  # keys of env.yaml

    @property
    def steps(self) -> int:
        """Number of decisions in an episode."""
        return max(1, math.ceil(self.horizon_s / self.decide_s - 1e-9))

    @property
    def parts(self) -> int:
        """Number of the world's steps between two decisions."""
        return math.ceil(self.decide_s / _MOST_STEP_S) if self.follows_programs else 1

    @property
    def signals(self) -> SignalsConfig:
        """The configuration of signals with agents."""
        return SignalsConfig(**self._signal_keys)

    @property
    def keys(self) -> dict[str, Any]:
        """The keys of env.yaml."""
        signals = {} if self.follows_programs else self._signal_keys
        return {
            "clock.sim_dt_s": TICK_S,
            "clock.ctrl_dt_s": self.decide_s / self.parts,
            "horizon_s": self.steps * self.decide_s,
            **{f"signals.{name}": value for name, value in signals.items()},
            **self.overrides,
        }

    @property
    def _signal_keys(self) -> dict[str, Any]:
        return {
            "agents": "all",
            "decide_s": float(self.decide_s),
            "yellow_s": float(self.yellow_s),
            "min_green_s": float(self.min_green_s),
            "max_green_s": 0.0,
            "greens": "all",
        }

    def write_config(self, path: Path) -> None:
        """Write a configuration of SUMO that names the files, the times and SUMO's options.

        Raises:
            MapError, DemandError: a file does not exist.
            ConfigError: `sumo_options` are not options of SUMO.
        """
        options = {
            "net-file": _files("net_file", self.net_file, MapError),
            "route-files": _files("route_file", self.route_file, DemandError),
            "begin": f"{self.begin_s:g}",
            "end": f"{self.begin_s + self.steps * self.decide_s:.10g}",
        }
        for name, value in _options(self.sumo_options):
            if name in options:
                raise ConfigError(
                    f"additional_sumo_cmd = {self.sumo_options!r}: {name} is set by another "
                    "argument, or twice; remove it here"
                )
            options[name] = value
        lines = [f"<{name} value={quoteattr(value)}/>" for name, value in options.items()]
        text = "\n".join(["<configuration>", *lines, "</configuration>\n"])
        path.write_text(text, encoding="utf-8")


class SignalWorld:
    """A world without agents' vehicles, whose signals have agents or follow their programs.

    Args:
        settings: see `WorldSettings`.

    Attributes:
        table: the signals with two or more greens.
        counts: (N, COUNTS) of the lanes of `table`; see `signals.kernels.lane_counts`.
        simulation: the simulation, whose only world (index 0) is this one.
        network: the map, with the programs that run.

    Raises:
        MapError, DemandError, RouteError, CapacityError: a file is missing or wrong.
        ConfigError: a setting is not possible, or no signal has two greens.
    """

    def __init__(self, settings: WorldSettings) -> None:
        with TemporaryDirectory(prefix="cavmarl-") as folder:
            file = Path(folder) / "world.sumocfg"
            settings.write_config(file)
            config, base_dir = load_config(file, agents=0, overrides=settings.keys)
            config.signals.need(
                "sensing",
                config.signals.sensing == "truth",
                "must be truth: sumo-rl's observations know all vehicles; leave the key out",
            )
            backend = find_backend(None, None, None)
            check_rendering(config, settings.render_mode, backend, RENDER_MODES)
            world = make_world(config, base_dir)
        world.tell_tolerated()
        self._settings = settings
        # Without agents there is no environment, so the simulation is driven directly.
        self.simulation = Simulation(
            config, world.network, demand=world.demand, partition=world.partition
        )
        self._clock = config.clock
        self.network: RoadNetwork = world.network
        controlled = self.network
        if settings.follows_programs:
            controlled = with_agent_programs(self.network, settings.signals)
        self.table = SignalTable(controlled)
        self.counts: NDArray[np.int64] = np.zeros((len(self.table.lanes), COUNTS), dtype=np.int64)
        self._stood: dict[int, tuple[int, int]] = {}  # vehicle → lane, and steps stopped on it
        self._steps = 0
        self._is_seeded = False
        self._view: WorldView | None = None

    @property
    def time_s(self) -> float:
        """Time since the episode began."""
        return self._steps * self._settings.decide_s

    @property
    def is_over(self) -> bool:
        """Whether the episode has reached its number of steps."""
        return self._steps >= self._settings.steps

    def reset(self, seed: int | None) -> None:
        """Begin an episode; None: the next one, or a random one."""
        if seed is not None or not self._is_seeded:
            self.simulation.seed(first_seed(seed, None))
            self._is_seeded = True
        self.simulation.reset()
        self._stood.clear()
        self._steps = 0
        self._count()

    def step(self, choices: NDArray[np.int64]) -> None:
        """Advance to the next decision; `choices` (S,) are greens or KEEP."""
        commands = Commands(np.zeros((1, 0, 2)), np.zeros((1, 0), dtype=np.int64))
        if not self._settings.follows_programs:
            commands = replace(commands, signal_choices=choices[None])
        for _ in range(self._settings.parts):
            self.simulation.step(commands)
            self._count()
        self._steps += 1

    def no_choices(self) -> NDArray[np.int64]:
        """Return KEEP for all signals."""
        return np.full(len(self.table.ids), KEEP, dtype=np.int64)

    def greens(self, signal: int) -> tuple[int, int, float]:
        """Return a signal's previous and current green, and the time since the last change.

        All three are 0 if signals follow their programs.
        """
        if self._settings.follows_programs:
            return 0, 0, 0.0
        state = self.simulation.signals.outputs.states[0, signal].tolist()
        ticks = int(self.simulation.ticks()[0]) - state[SINCE]
        return state[PREVIOUS], state[GREEN], round(ticks * self._clock.sim_dt_s, 6)

    def out_lanes(self, signal: str) -> list[int]:
        """Return the lanes behind a signal, as indices of the table's lanes.

        As in sumo-rl, only the first link of each letter counts.
        """
        links = self.network.links
        links = links[links["signal"] == self.network.signal_ids.index(signal)]
        _, first = np.unique(links["signal_index"], return_index=True)
        lanes = self.table.arrays.lane_index[links["to_lane"][first]].tolist()
        return [*dict.fromkeys(lanes)]

    def num_phases(self, signal: str) -> int:
        """Return the number of phases of a signal's current program."""
        row = self.network.signal_ids.index(signal)
        return int(self.network.programs[self.network.signals["program"][row]]["num_phases"])

    def stood_s(self, lanes: Sequence[int]) -> list[float]:
        """Return for each lane the total time for which its vehicles have been stopped."""
        unit_s = self._clock.sim_dt_s
        if self._settings.follows_programs:
            unit_s = self._clock.ctrl_dt_s
        found: list[float] = (self.counts[lanes, STOOD_TICKS] * unit_s).tolist()
        return found

    def vehicles(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the speed of each vehicle in m/s, and the time in s since it stopped."""
        rows = self.simulation.vehicles(0)
        return np.abs(rows["speed"]), rows["wait_s"]

    def picture(self, mode: str) -> NDArray[np.uint8] | None:
        """Return a frame of the world, or show it in a window; see `CavEnv.render`."""
        if self._view is None:
            fps = max(1, round(1.0 / self._clock.ctrl_dt_s))
            self._view = WorldView(self.simulation, mode, self.network.name, fps)
        return self._view.show()

    def close(self) -> None:
        """End the world."""
        if self._view is not None:
            self._view.close()
        self.simulation.close()

    def _count(self) -> None:
        """Count the vehicles on the lanes of signals."""
        if not self._settings.follows_programs:
            self.counts = self.simulation.signals.outputs.counts[0]
            return
        rows = self.simulation.vehicles(0)
        lanes = self.table.arrays.lane_index[rows["lane"]]
        rows, lanes = rows[lanes >= 0], lanes[lanes >= 0]
        speed = np.abs(rows["speed"])
        stands = speed < STANDING_MPS
        before, self._stood = self._stood, {}
        stood = np.zeros(len(rows), dtype=np.int64)
        for k, (vehicle, lane) in enumerate(zip(rows["id"].tolist(), lanes.tolist(), strict=True)):
            last_lane, steps = before.get(vehicle, (lane, 0))
            stood[k] = (steps if last_lane == lane else 0) + bool(stands[k])
            self._stood[vehicle] = lane, int(stood[k])
        desired = self.table.arrays.speed_mps[lanes] * np.maximum(rows["speed_factor"], 1e-3)
        added = np.empty((len(rows), COUNTS), dtype=np.int64)
        added[:, VEHICLES] = 1
        added[:, STANDING] = stands
        added[:, STOOD_TICKS] = stood
        added[:, SPEED_PPM] = np.floor(speed / desired * 1e6 + 0.5)
        added[:, LENGTH_MM] = np.floor(rows["length"] * 1e3 + 0.5)
        self.counts = np.zeros_like(self.counts)
        np.add.at(self.counts, lanes, added)


def _files(argument: str, names: str, failure: type[MapError | DemandError]) -> str:
    """Return files, separated by commas, as the value of an option of SUMO."""
    found = []
    for name in os.fspath(names).split(","):
        path = Path(name.strip())
        if not path.is_file():
            raise failure(f"{argument} = {name.strip()!r}: no such file; give an existing file")
        found.append(quote(str(path.resolve())))
    return ",".join(found)


def _options(text: str) -> Iterator[tuple[str, str]]:
    """Yield the options of a command line of SUMO, by their main names, with their values."""
    words = shlex.split(text)
    while words:
        word = words.pop(0)
        name, has_value, value = word.lstrip("-").partition("=")
        option = known_options().get(name)
        if option is None or not word.startswith("-"):
            raise ConfigError(
                f"additional_sumo_cmd = {text!r}: {word!r} is not an option of SUMO; write them as "
                "for the program sumo"
            )
        if not has_value:
            is_flag = option.default in ("true", "false")
            value = "true" if is_flag or not words else words.pop(0)
        if option.kind == "files":
            value = _files("additional_sumo_cmd", value, DemandError)
        yield option.name, value
