"""Loading of a world by name: its configuration, roads, demand and zones."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple
from weakref import WeakValueDictionary

from cavmarl.config.env import BY_MAP, EnvConfig
from cavmarl.config.registry import (
    entries,
    load_config,
    resolve_buildings,
    resolve_demand,
    resolve_map,
    resolve_maps,
    resolve_programs,
    resolve_zones,
)
from cavmarl.config.zones import ZONE_LAYOUTS
from cavmarl.core.errors import ConfigError, MapError
from cavmarl.core.huge_pages import trim
from cavmarl.core.xml_root import is_sumo_config
from cavmarl.driving.steered_sweeps import load_steered
from cavmarl.limits.limit_table import limit_sizes
from cavmarl.maps.buildings import with_buildings
from cavmarl.maps.contraflow import contraflow_network
from cavmarl.maps.netconvert import conversion_notes, map_file
from cavmarl.networks.background_driver import background_drivers
from cavmarl.networks.trained_maps import note_of, untrained_kinds
from cavmarl.roads.cache import load_network
from cavmarl.roads.default_horizon import horizon_of
from cavmarl.roads.held_signals import held_signals_note
from cavmarl.roads.joined_maps import join
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import map_name, source_hash
from cavmarl.roads.sumo_net.signal_plans import with_outages, with_programs
from cavmarl.roads.sumo_net.sumo_options import additional_files_of
from cavmarl.signals.agent_programs import with_agent_programs
from cavmarl.signals.signal_table import SignalSizes, sizes_of
from cavmarl.traffic.demand import DemandFile, read_demand
from cavmarl.traffic.demand.sumo_config import read_sumo_config
from cavmarl.traffic.native import capacity_of
from cavmarl.traffic.scenarios.library import plan_scene
from cavmarl.traffic.scenarios.logged_demand import check_logged_world, demand_of_log
from cavmarl.traffic.sumo.sumo_demand import SumoDemand, read_sumo_demand
from cavmarl.traffic.sumo.sumo_input import read_input
from cavmarl.zones.partition.zone_file import zones_for
from cavmarl.zones.partition.zone_layouts import cut_map
from cavmarl.zones.partition.zone_partition import ZonePartition

log = logging.getLogger(__name__)

# Networks that are in use in this process. The key is whether vehicles are steered, followed by the
# names and hashes of the map files.
_LOADED: WeakValueDictionary[tuple[object, ...], RoadNetwork] = WeakValueDictionary()


class World(NamedTuple):
    """The configuration of a world and the data that it names."""

    config: EnvConfig
    network: RoadNetwork
    # vehicles in addition to the generator's, from a demand file or from SUMO
    demand: DemandFile | SumoDemand | None
    partition: ZonePartition

    def tell_tolerated(self) -> None:
        """Log what was left out or replaced in the demand, with counts."""
        if self.demand is not None and self.demand.tolerated:
            lines = "\n".join(self.demand.tolerated)
            log.warning("%s: tolerated in the demand:\n%s", self.config.name, lines)

    @property
    def signal_sizes(self) -> SignalSizes:
        """Sizes of the arrays about agents of signals or of speed limits."""
        return roadside_sizes(self.config, self.network)

    @property
    def capacity(self) -> int:
        config = self.config
        dt, horizon_s = config.clock.sim_dt_s, config.horizon_s
        room = capacity_of(self.network, config.population, self.demand, dt, horizon_s)
        scene = plan_scene(config.scenario, self.network, config.population.agents)
        return room + (0 if scene is None else scene.num_rows)


def roadside_sizes(config: EnvConfig, network: RoadNetwork) -> SignalSizes:
    """Return the sizes of the arrays about controlled signals or limits."""
    if config.signals.are_controlled:
        return sizes_of(network, config.signals.range_m)
    if config.limits.are_controlled:
        return limit_sizes(config.limits)
    return SignalSizes()


def load_world(
    env: str | Path,
    *,
    zones: int | None = None,
    agents: int | None = None,
    background: int | None = None,
    max_cycles: int | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> World:
    """Load the world that an entry, a folder or a map file describes.

    Keywords are as in `parallel_env`.

    Raises:
        ConfigError: a key, a value or a combination of them is invalid, or the zones do not fit
            the map.
        MapError: the map cannot be read, or has no roads to drive on.
        DemandError: a demand file is missing, damaged or of another map.
        RouteError: a route of the demand is not connected.
        PolicyError: background vehicles cannot have a driver that `traffic.model` names.
    """
    config, base_dir = load_config(
        env,
        zones=zones,
        agents=agents,
        background=background,
        max_cycles=max_cycles,
        overrides=overrides,
    )
    return make_world(config, base_dir)


def make_world(config: EnvConfig, base_dir: Path) -> World:
    """Load the world of a configuration, whose horizon may be derived from the map.

    Raises the errors of `load_world`.
    """
    drivers = background_drivers(config.traffic)  # refuses drivers before the map is read
    network = load_roads(config, base_dir)
    for driver in drivers:
        for kind in untrained_kinds(network, driver.maps):
            _warn_once(network.name, network.source_hash, note_of(driver.name, kind))
    scene = plan_scene(config.scenario, network, config.population.agents)
    if config.horizon_s == BY_MAP:
        step_s = config.clock.ctrl_dt_s
        rest_s = horizon_of(network)
        if scene is not None and scene.log is not None:
            log = scene.log
            rest_s = (log.scene.num_times - 1 - log.first) * log.scene.step_s
        config = replace(config, horizon_s=step_s * max(1, round(rest_s / step_s)))
    files = _demand_files(config, base_dir)
    demand: DemandFile | SumoDemand | None = None
    if scene is not None and scene.log is not None:
        check_logged_world(config)
        for note in scene.log.notes:
            _warn_once(network.name, network.source_hash, note)
        demand = demand_of_log(scene.log, network, config.traffic)
    if config.traffic.source != "native":
        network = with_programs(network, read_input(files).additional_files)
        path = map_file(resolve_map(config, base_dir)).resolve()
        outages = {} if scene is None else dict(scene.outages)
        demand = read_sumo_demand(config, network, path, files, outages)
    elif files:
        demand = read_demand(
            files,
            network,
            on_bad_route=config.traffic.on_bad_route,
            programs=_program_files(config, base_dir),
        ).begun(config.horizon_s)
    if scene is not None and scene.outages:
        network = with_outages(network, dict(scene.outages))
    trim()  # return the memory that reading files has freed
    return World(config, network, demand, load_zones(config, base_dir, network))


def load_roads(config: EnvConfig, base_dir: Path) -> RoadNetwork:
    """Load the roads of a configuration, with its buildings and signal programs.

    Raises:
        MapError: the map or a file of buildings or programs cannot be read, or a file does not fit
            the map.
    """
    paths = resolve_maps(config, base_dir)
    is_steered = config.population.agents > 0 or bool(config.traffic.networks)
    network = _joined(paths, is_steered, config.map.contraflow)
    if len(network.maps) > 1:
        _refuse_single_map_keys(config)
    buildings = resolve_buildings(config, base_dir)
    if buildings is not None:
        network = with_buildings(network, buildings)
    network = with_programs(network, _program_files(config, base_dir), config.map.program)
    network = with_agent_programs(network, config.signals)
    if note := held_signals_note(network):
        _warn_once(network.name, network.source_hash, note)
    return network


@cache
def _warn_once(name: str, source_hash: str, note: str) -> None:
    log.warning("%s: %s", name, note)


def _demand_files(config: EnvConfig, base_dir: Path) -> list[Path]:
    """Return the files of `traffic.demand`.

    A configuration of SUMO that is also the map need not name a demand; then there are no files.
    """
    files = resolve_demand(config, base_dir)
    if files and files == resolve_maps(config, base_dir):
        return files if any(read_sumo_config(path).files for path in files) else []
    return files


def _program_files(config: EnvConfig, base_dir: Path) -> list[Path]:
    """Return the files with signal programs: `map.programs`, and the files that a map names.

    If SUMO runs the traffic, it reads the files that its configuration names.
    """
    programs = resolve_programs(config, base_dir)
    if config.traffic.source != "native":
        return programs
    maps = resolve_maps(config, base_dir)
    named = [file for path in maps if is_sumo_config(path) for file in additional_files_of(path)]
    if named and len(maps) > 1:
        raise ConfigError(
            f"map.source = {config.map.source!r}: a configuration of SUMO with additional files "
            "must be the only map; name its net-file instead"
        )
    known = {file.resolve() for file in programs}
    return [*(file for file in named if file.resolve() not in known), *programs]


def _joined(paths: Sequence[Path], is_steered: bool, contraflow: Sequence[str] = ()) -> RoadNetwork:
    """Return the network of map files. Worlds of one process share a network of the same files.

    If policies or networks steer vehicles, the roads include the swept areas of steered vehicles.
    `contraflow`: ids of roads that can be reversed.

    Raises MapError with the errors of all files.
    """
    files: list[Path] = []
    contents: list[tuple[str, str]] = []
    refused: list[str] = []
    for path in paths:
        try:
            file = map_file(path)
            if contraflow:
                file = contraflow_network(file, contraflow)
            contents.append((map_name(file), source_hash(file)))
            files.append(file)
        except MapError as error:
            refused.append(str(error))
    found = None if refused else _LOADED.get((is_steered, *contents))
    if found is not None:
        return found
    networks: list[RoadNetwork] = []
    for file in files:
        try:
            networks.append(load_steered(file) if is_steered else load_network(file))
        except MapError as error:
            refused.append(str(error))
    if refused:
        raise MapError("\n".join(refused))
    network = join(networks)
    for file in files:
        for note in conversion_notes(file):
            log.warning("%s: %s", map_name(file), note)
    for note in network.notes:
        log.warning("%s: %s", network.name, note)
    return _LOADED.setdefault((is_steered, *contents), network)


def _refuse_single_map_keys(config: EnvConfig) -> None:
    """Refuse keys that name elements of one map if there are several maps."""
    named = {
        "map.programs": config.map.programs,
        "map.program": config.map.program,
        "map.buildings": config.map.buildings,
        "traffic.demand": config.traffic.demand,
        "traffic.origins": config.traffic.origins,
        "traffic.destinations": config.traffic.destinations,
        "scenario.name": config.scenario.name,
        "population.insertions": config.population.insertions,
        "population.external": config.population.external,
        "signals.overrides": config.signals.overrides,
        "map.changed_lanes": config.map.changed_lanes,
        "map.contraflow": config.map.contraflow,
        "zones.layout": config.zones.layout not in ZONE_LAYOUTS and config.zones.layout,
    }
    for key, value in named.items():
        if value:
            raise ConfigError(
                f"{key} = {value!r}: needs a single map, but map.source names several; remove "
                f"{key}, or name one map"
            )


def load_zones(config: EnvConfig, base_dir: Path, network: RoadNetwork) -> ZonePartition:
    """Return the zones of a configuration, from its zone file or by cutting the map.

    Raises:
        ConfigError: the zone file cannot be read, or belongs to another map or number of zones; or
            the map cannot be cut into this many zones.
    """
    settings = config.zones
    path = resolve_zones(config, base_dir)
    if path is not None:
        return zones_for(network, path, settings.count)
    return cut_map(
        network,
        settings.layout,
        settings.count,
        avoid_junctions=settings.avoid_junctions,
        weight=settings.weight,
    )


def find_map(env: str | Path) -> Path:
    """Return the path of the SUMO network of an entry, a folder or a map file.

    Raises:
        UnknownEnvironmentError: there is no entry, folder or file of this name.
        MapError: the map cannot be read.
    """
    if str(env) not in entries() and Path(env).is_file():
        return map_file(env).resolve()
    return map_file(resolve_map(*load_config(env))).resolve()


def check_agents(config: EnvConfig, *, may_be_alone: bool = False) -> None:
    """Refuse a world without agents if the caller wants to drive agents.

    `may_be_alone`: whether a world with `traffic.demand` may have no agents.
    """
    is_alone = may_be_alone and config.drives_alone
    if config.population.agents == 0 and config.roadside is None and not is_alone:
        raise ConfigError(
            "population.agents = 0: an environment needs at least one agent; set it higher, or let "
            "agents control signals (signals.agents) or speed limits (limits.agents)"
        )
