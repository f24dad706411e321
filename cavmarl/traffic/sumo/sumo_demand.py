"""`SumoDemand`: SUMO files checked against a map, with all that is needed to run them."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import ConfigError, DemandError
from cavmarl.core.records.codes import CLASS_PEDESTRIAN, MODEL_KRAUSS
from cavmarl.driving.vehicle_types import (
    NEAREST_CLASS,
    NO_ROAD_CLASSES,
    VTYPE,
    agent_types,
    generated_types,
    names_beside_car,
    set_model,
)
from cavmarl.roads.network import VEHICLE_CLASSES, RoadNetwork
from cavmarl.roads.sumo_net.xml_source import read_bytes
from cavmarl.traffic.scenarios.movement_scripts import actor_types
from cavmarl.traffic.sumo.sumo_input import (
    SumoInput,
    begun,
    command_words,
    read_input,
    read_unmirrored,
)
from cavmarl.traffic.sumo.sumo_process import SumoProcess, choose_interface

_SAME_NAME = ("length", "width", "height", "min_gap", "accel", "decel", "emergency_decel", "tau",
              "sigma", "max_speed", "speed_factor", "speed_dev")  # fmt: skip


@dataclass(frozen=True, eq=False)
class SumoDemand:
    """The settings with which each SUMO process of an environment is started."""

    network: RoadNetwork
    map_file: Path  # the network, as SUMO reads it
    given: SumoInput  # demand and options
    drives: bool  # whether SUMO moves its vehicles (`sumo-traffic`), or only orders departures
    max_vehicles: int  # maximum number per world
    replay_bytes: int  # maximum size of a world's log of an episode, see `ToldLog`
    dt_s: float
    interface: str  # `libsumo` or `traci`
    version: str  # version of SUMO
    types: NDArray[np.void]  # VTYPE (num_types,) of the road vehicles
    # VTYPE (n,) of this package's vehicles besides the car; a world's table has them after `types`
    puppets: NDArray[np.void]
    num_persons: int  # maximum number of persons that a world mirrors at a time
    num_callers: int  # number of slots for the caller's vehicles; then come the persons' slots
    outages: Mapping[str, float]  # time of failure by signal, in s since the reset
    reroutes: str  # which vehicles take another route if lanes change; empty: lanes do not change
    type_ids: tuple[str, ...]  # names of `types`, then of types that do not use roads
    content_hash: str  # hash of all files

    @property
    def tolerated(self) -> tuple[str, ...]:
        """Ignored and unusual parts of the files, one line each with its count."""
        return self.given.tolerated

    def setup(self) -> dict[str, Any]:
        """Return the setup that a process receives once; VTYPE rows refer to the world's table."""
        return _names(self.network, self.interface) | {
            "drives": self.drives,
            "reroutes": self.reroutes,
            "persons": self.num_persons,
            "outages_ms": {
                name: round(1000.0 * (self.given.begin_s + at_s))
                for name, at_s in self.outages.items()
            },
            "types": {
                name: row + len(generated_types()) if row < len(self.types) else -1
                for row, name in enumerate(self.type_ids)
            },
        }

    def words(self, folder: Path, seed: int) -> list[str]:
        """Return SUMO's command line; `folder` is for files that SUMO reads."""
        words = _words(
            self.map_file, self.given, folder, self.dt_s, self.max_vehicles, seed, self._puppets()
        )
        # Without this, SUMO exits if a vehicle enters whose route leads over a closed road.
        return [*words, "--ignore-route-errors=true"] if self.reroutes else words

    def _puppets(self) -> dict[int, np.void]:
        """Return the types of vehicles besides the car that SUMO does not move, by VTYPE row."""
        first = len(generated_types()) + len(self.types)
        return {first + row: kind for row, kind in enumerate(self.puppets)}


def read_sumo_demand(
    config: EnvConfig,
    network: RoadNetwork,
    map_file: Path,
    files: Sequence[Path],
    outages: Mapping[str, float],
) -> SumoDemand:
    """Let SUMO read all files of an environment, and return the checked demand.

    `config`: the environment; its `traffic.source` is one of SUMO's. `map_file`: the network, as
    SUMO reads it. `files`: one `.sumocfg`, or files of routes and additional files. `outages`: time
    of failure by signal, in s since the beginning of the episode.

    Raises DemandError: SUMO refuses the files on this map (the error quotes SUMO), or its signals
    differ from the map's; MissingExtraError: SUMO is not installed.
    """
    given = begun(read_input(files), config.horizon_s)
    interface = choose_interface(config.sumo.interface)
    process = SumoProcess(
        _names(network, interface)
        | {"types": {}, "drives": False, "reroutes": "", "persons": 0, "outages_ms": {}}
    )
    try:
        with tempfile.TemporaryDirectory() as folder:
            words = _words(map_file, given, Path(folder), config.clock.sim_dt_s, 1, 0, {})
            # Read the whole demand, not only its first minutes.
            found = process.look_up([*words, "--route-steps=0"])
    except ConfigError as error:
        own = f", {given.net_file}" if given.net_file else ""
        raise DemandError(
            f"{', '.join(map(str, files))}: {error}\nCure: give demand that was made for the map "
            f"{map_file}, or the map that it was made for{own}"
        ) from error
    finally:
        process.close()
    _check_signals(network, found["signals"], files)
    on_road = {
        name: kind
        for name, kind in found["types"].items()
        if kind["vclass"] not in NO_ROAD_CLASSES and not name.startswith("cavmarl.")
    }
    others = [name for name in found["types"] if name not in on_road]
    drives = config.traffic.source == "sumo-traffic"
    most_persons = config.sumo.max_persons if drives else 0
    off_road = {name: found["types"][name]["vclass"] for name in others}
    unmirrored, has_persons = read_unmirrored(given, off_road, most_persons)
    num_persons = most_persons if has_persons else 0
    return SumoDemand(
        network,
        map_file,
        replace(given, tolerated=(*given.tolerated, *unmirrored)),
        drives=drives,
        max_vehicles=config.sumo.max_vehicles,
        replay_bytes=config.sumo.replay_mib << 20,
        dt_s=config.clock.sim_dt_s,
        interface=interface,
        version=found["version"],
        types=_types(list(on_road.values())),
        puppets=_puppet_types(config, num_persons),
        num_persons=num_persons,
        num_callers=config.population.external,
        outages=outages,
        reroutes=config.population.reroute if config.may_change_lanes else "",
        type_ids=(*on_road, *others),
        content_hash=_hash(given),
    )


def _names(network: RoadNetwork, interface: str) -> dict[str, Any]:
    return {
        "interface": interface,
        "lanes": list(network.lane_ids),
        "edges": list(network.edge_ids),
        "signals": list(network.signal_ids),
        "classes": [
            [name for name, nearest in NEAREST_CLASS.items() if nearest == one]
            for one in VEHICLE_CLASSES
        ],
    }


def _words(
    map_file: Path,
    given: SumoInput,
    folder: Path,
    dt_s: float,
    most: int,
    seed: int,
    others: Mapping[int, np.void],
) -> list[str]:
    puppets = folder / "puppets.add.xml"
    has_walking_areas = _has_walking_areas(map_file, map_file.stat().st_mtime_ns)
    puppets.write_text(_puppets(others, has_walking_areas), encoding="utf-8")
    own = int(given.options.get("max-num-vehicles", "-1"))
    more = {
        # This package detects contacts; SUMO must not remove vehicles after a contact.
        "collision.action": "none",
        "max-num-vehicles": str(min(own, most) if own > 0 else most),
        "random": "false",  # true would draw an unknown seed
    }
    return command_words(map_file, given, folder, dt_s, seed, more, (puppets,))


@lru_cache(maxsize=64)  # SUMO is started for each episode
def _has_walking_areas(map_file: Path, changed_ns: int) -> bool:
    return b'function="walkingarea"' in read_bytes(map_file)


def _puppets(others: Mapping[int, np.void], has_walking_areas: bool) -> str:
    """Return types for vehicles that SUMO neither moves nor teleports.

    `others`: VTYPE of all such vehicles besides the car, by VTYPE row. `has_walking_areas`: whether
    the map has areas for pedestrians, in which SUMO would crash with a vehicle.
    """
    car = {row: (kind, "") for row, kind in enumerate(generated_types())}
    # SUMO's drivers assume that the car brakes like a car of SUMO.
    rest = {
        row: (
            kind,
            f'accel="{kind["accel"]}" decel="{kind["decel"]}" '
            f'emergencyDecel="{kind["emergency_decel"]}" minGap="{kind["min_gap"]}" ',
        )
        for row, kind in others.items()
    }
    every = car | rest
    classes = {
        row: _puppet_class(kind) if has_walking_areas else "ignoring"
        for row, (kind, _) in every.items()
    }
    kinds = "".join(
        f'<vType id="cavmarl.{row}" vClass="{classes[row]}" length="{kind["length"]}" '
        f'width="{kind["width"]}" height="{kind["height"]}" maxSpeed="{kind["max_speed"]}" '
        f'{limits}timeToTeleport="1000000"/>'
        for row, (kind, limits) in every.items()
    )
    return f"<additional>{kinds}</additional>"


def _puppet_class(kind: np.void) -> str:
    """Return the class of SUMO whose lanes a VTYPE may use."""
    is_person = kind["vclass"] == CLASS_PEDESTRIAN
    return "passenger" if is_person else VEHICLE_CLASSES[kind["vclass"]]


def _puppet_types(config: EnvConfig, num_persons: int) -> NDArray[np.void]:
    """Return VTYPE (n,) of vehicles of agents, the caller and a scenario besides the car."""
    population = config.population
    names = names_beside_car(population, population.external + num_persons > 0)
    types = agent_types(names, own=population.own_types)
    return np.concatenate([actor_types(), types]) if config.scenario.name else types


def _types(described: list[dict[str, Any]]) -> NDArray[np.void]:
    """Return VTYPE (n,) of SUMO's types, with Krauss's model for drivers of this package."""
    types = np.zeros(len(described), dtype=VTYPE)
    for row, kind in zip(types, described, strict=True):
        for name in _SAME_NAME:
            row[name] = kind[name]
        row["vclass"] = VEHICLE_CLASSES.index(NEAREST_CLASS[kind["vclass"]])
        row["permissions"] = 1 << int(row["vclass"])
        set_model(row, MODEL_KRAUSS)
        row["desired_max_speed"] = row["max_speed"]
        row["max_speed_factor"] = np.inf
        row["reroute"] = row["reroute_period_ms"] = -1
    return types


def _check_signals(network: RoadNetwork, found: dict[str, int], files: Sequence[Path]) -> None:
    for name, row in zip(network.signal_ids, network.signals, strict=True):
        if found.get(name) != row["num_links"]:
            raise DemandError(
                f"{', '.join(map(str, files))}: signal '{name}' has {found.get(name, 'no')} "
                f"letters in SUMO and {row['num_links']} on the map '{network.name}'; give files "
                "that were made for this map"
            )


def _hash(given: SumoInput) -> str:
    digest = hashlib.sha256(repr((given.begin_s, sorted(given.options.items()))).encode())
    for path in (*given.route_files, *given.additional_files):
        digest.update(read_bytes(path))
    return digest.hexdigest()
