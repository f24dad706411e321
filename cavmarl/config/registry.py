"""Finds the entries of `envs/` and `agents/`.

A name is looked up in the working directory, then in the data of the wheel or, in a checkout,
beside the package. Instead of a name, the path of a folder or of a map file can be given.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Callable, Iterable, Mapping
from os.path import isdir, isfile
from pathlib import Path
from typing import Any

import numpy as np

from cavmarl.config.env import BY_MAP, EnvConfig, MapConfig
from cavmarl.config.population import PopulationConfig
from cavmarl.config.scenario import ScenarioConfig, path_of_code
from cavmarl.config.traffic import TrafficConfig
from cavmarl.config.zones import ZONE_LAYOUTS
from cavmarl.core.errors import (
    CavmarlError,
    ConfigError,
    DemandError,
    MapError,
    UnknownEnvironmentError,
    require,
)
from cavmarl.core.extensions import load_plugins
from cavmarl.core.scene_names import SCENE_SUFFIXES, is_scene_file
from cavmarl.core.xml_root import SUMO_CONFIG_SUFFIX, is_sumo_config

_NATIVE = (".net.xml", ".net.xml.gz")  # read directly; SUMO's netconvert converts other formats
MAP_SUFFIXES = (*_NATIVE, ".osm", ".osm.gz", ".osm.xml", ".xodr")

PACKAGE = Path(__file__).resolve().parents[1]
SUMO_PREFIX = "sumo:"


def places(kind: str) -> list[Path]:
    """Return the folders with entries of `kind` (`envs`, `agents`, `configs`); the first wins."""
    return [place for place in (Path.cwd() / kind, _ours(kind)) if place.is_dir()]


def _ours(kind: str) -> Path:
    """Return the folder in the wheel or, if there is none, in the checkout."""
    packaged = PACKAGE / "data" / kind
    return packaged if packaged.is_dir() else PACKAGE.parent / kind


def entries() -> dict[str, Path]:
    """Return every environment that has a name: name → its folder, sorted by name."""
    return _collect("envs", _environment_name)


def agent_entries() -> dict[str, Path]:
    """Return every driver that has a name: name → `NAME.py`, or the folder of a trained driver.

    The working directory's `agents/` adds trained drivers with other names. A script there can only
    be given by its path, so that no code runs by accident.
    """
    own = {name: path for name, path in _collect("agents", _agent_name).items() if path.is_dir()}
    ours = places("agents")[-1:]
    return dict(sorted((own | _named(ours, _agent_name)).items()))


def programs() -> dict[str, Path]:
    """Return the package's training programs, not the working directory's: name → path."""
    ours = _ours("train")
    return {path.stem: path for path in sorted(ours.glob("*.py"))}


def agent_here(name: str) -> Path | None:
    """Return a driver of this name in the working directory that is not in `agent_entries`."""
    for path in (Path.cwd() / "agents" / f"{name}.py", Path.cwd() / "agents" / name):
        is_driver = isfile(path) if path.suffix == ".py" else _agent_name(path) is not None
        if is_driver and agent_entries().get(name) != path:
            return path
    return None


def find_entry(env: str | Path) -> Path:
    """Return the entry folder or the map file that `env` means.

    Args:
        env: a name from `entries()`, a folder with an `env.yaml`, a map file, a configuration of
            SUMO, or a logged scene.

    Raises:
        UnknownEnvironmentError: nothing has that name; the message lists all names.
    """
    if not isinstance(env, (str, Path)):
        raise UnknownEnvironmentError(
            f"env = {env!r}: must be the name of an environment, or the path of a folder or a map"
        )
    known = entries()
    if isinstance(env, str) and env in known:
        return known[env]
    path = Path(env)
    if isfile(path / "env.yaml"):  # unlike Path.is_file, isfile accepts names that no file can have
        return path
    if isfile(path):
        suffixes = (*MAP_SUFFIXES, *SCENE_SUFFIXES)
        if not path.name.endswith(suffixes) and not is_sumo_config(path):
            raise UnknownEnvironmentError(
                f"{path}: not a map file; the name must end in {' or '.join(suffixes)}, or its "
                "root element must be the <configuration> of SUMO"
            )
        return path
    if isdir(path):
        raise UnknownEnvironmentError(f"{path}: a folder without env.yaml; add one, or give a map")
    raise UnknownEnvironmentError(
        f"no environment, folder or map file '{env}'; {_advice(env, known)}"
    )


def load_config(
    env: str | Path,
    *,
    zones: int | None = None,
    zone_simulators: Mapping[int, str] | None = None,
    sensor_workers: int | None = None,
    agents: int | None = None,
    background: int | None = None,
    max_cycles: int | None = None,
    overrides: Mapping[str, object] | None = None,
) -> tuple[EnvConfig, Path]:
    """Return the configuration of an environment, and the folder that relative paths start from.

    Args:
        env: see `find_entry`. A map file gets a default environment, whose horizon depends on the
            map: see `make_world`. A configuration of SUMO also sets `traffic.demand`, and a logged
            scene `scenario.name`; then no background vehicles are generated.
        zones: sets `zones.count`.
        zone_simulators: sets `zones.simulators`.
        sensor_workers: sets `workers.sensors`.
        agents: sets `population.agents`.
        background: sets `population.background`.
        max_cycles: sets `horizon_s` to this number of steps.
        overrides: dotted key → value, for all other keys: `{"sensors.lidar.rays": 64}`. As in an
            env.yaml, `rig` may be the name of a rig in `configs/rigs`, or of a file. `plugins` are
            added to the plugins of the environment.

    Raises:
        UnknownEnvironmentError: nothing has that name.
        ConfigError: a key, a type or a value is not allowed, or a plugin cannot be imported; the
            message suggests the nearest allowed value.
    """
    from cavmarl.config.io import read_yaml, validate

    load_plugins_of(env, overrides)
    found = find_entry(env)
    if found.is_dir():
        base_dir, where = found, str(found / "env.yaml")
        keys = read_yaml(found / "env.yaml")
        if isinstance(keys, dict) and isinstance(keys.get("rig"), str):
            keys["rig"] = load_rig(keys["rig"], base_dir)
        _refuse_code(keys, where)
        config = validate(EnvConfig, keys, where)
    else:
        base_dir, where = found.parent, str(found)
        config = _config_of_file(found)
    keywords = {
        "zones.count": zones,
        "zones.simulators": zone_simulators,
        "workers.sensors": sensor_workers,
        "population.agents": agents,
        "population.background": background,
        "horizon_s": max_cycles,
    }
    given = {key: value for key, value in keywords.items() if value is not None}
    if not isinstance(overrides, Mapping | None):
        raise ConfigError(f"overrides = {overrides!r}: must map dotted keys to values")
    values = dict(overrides or {})
    if strange := [key for key in values if not isinstance(key, str)]:
        raise ConfigError(f"overrides: {strange[0]!r} is not a key; a key is a dotted name")
    if twice := given.keys() & values.keys():
        raise ConfigError(f"{min(twice)} is given in overrides and as a keyword; use one of them")
    values |= {key: value for key, value in given.items() if key != "horizon_s"}
    if values or max_cycles is not None:
        raw = dataclasses.asdict(config)
        if isinstance(plugins := values.get("plugins"), list | tuple):
            more = [name for name in plugins if name not in config.plugins]
            values["plugins"] = [*config.plugins, *more]
        for key, value in values.items():
            is_named = key == "rig" and isinstance(value, str)
            shadow(raw, key, load_rig(str(value), base_dir) if is_named else value)
        if max_cycles is not None:
            raw["horizon_s"] = _horizon_s(max_cycles, raw)
        config = validate(EnvConfig, raw, f"{where}, overridden")
    return _with_scene_path(config, base_dir), base_dir


def _with_scene_path(config: EnvConfig, base_dir: Path) -> EnvConfig:
    """Make the path of a logged scene absolute, so that all processes of a world find it."""
    name = config.scenario.name
    if not is_scene_file(name) or Path(name).is_absolute():
        return config
    path = base_dir / name if isfile(base_dir / name) else Path(name)
    scenario = dataclasses.replace(config.scenario, name=str(path.resolve()))
    return dataclasses.replace(config, scenario=scenario)


def _config_of_file(path: Path) -> EnvConfig:
    """Return the default configuration of a map file, a configuration of SUMO or a scene."""
    config = EnvConfig(name=_map_name(path), map=MapConfig(source=path.name), horizon_s=BY_MAP)
    if is_scene_file(path.name):
        return dataclasses.replace(
            config,
            scenario=ScenarioConfig(name=path.name),
            population=PopulationConfig(agents=1, background=0),
            traffic=TrafficConfig(min_trip_m=0.0),  # scenes are small
        )
    if not is_sumo_config(path):
        return config
    return dataclasses.replace(
        config,
        traffic=TrafficConfig(demand=(path.name,)),
        population=PopulationConfig(background=0),
    )


def load_plugins_of(env: str | Path, overrides: Mapping[str, object] | None = None) -> None:
    """Import the plugins that the env.yaml of an environment and overrides name.

    Raises:
        UnknownEnvironmentError: nothing has that name.
        ConfigError: env.yaml cannot be read, or a plugin cannot be imported.
    """
    from cavmarl.config.io import read_yaml

    file = find_entry(env) / "env.yaml"
    named = {str(file): read_yaml(file) if isfile(file) else None, "overrides": overrides}
    for where, keys in named.items():
        plugins = keys.get("plugins") if isinstance(keys, Mapping) else None
        if not isinstance(plugins, list | tuple):
            continue  # `validate` reports a value of another type
        try:
            load_plugins(name for name in plugins if isinstance(name, str))
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from error


def find_settings(what: str, name: str) -> Path:
    """Return the path `name` if it is a file, else the file with this name in `configs/`.

    `what`: `rig`, `suite` or `train`.
    """
    if Path(name).is_file():
        return Path(name)
    folder, usual = {
        "rig": ("rigs", "ten_sensors"), "suite": ("suites", "tasks"), "train": ("train", "merge")
    }[what]  # fmt: skip
    for place in places("configs"):
        path = place / folder / f"{name}.yaml"
        if path.is_file():
            return path
    raise ConfigError(f"no {what} or file '{name}': give '{usual}' or the path of a .yaml file")


def _refuse_code(keys: object, where: str) -> None:
    """Raise an error if an env.yaml names code or programs, which only the caller may name."""
    scenario = keys.get("scenario") if isinstance(keys, dict) else None
    name = scenario.get("name") if isinstance(scenario, dict) else None
    if isinstance(name, str) and path_of_code(name):
        raise ConfigError(
            f"{where}: scenario.name = {name!r} is code, which a folder of data must not run; if "
            f"you trust it, pass overrides={{'scenario.name': {name!r}}} or --set scenario.name"
        )
    zones = keys.get("zones") if isinstance(keys, dict) else None
    if isinstance(zones, dict) and zones.get("simulators"):
        raise ConfigError(
            f"{where}: zones.simulators names other programs, which a folder of data must not use; "
            "pass zone_simulators, or --set zones.simulators"
        )


def load_rig(name: str, base_dir: Path | None = None) -> dict[str, Any]:
    """Return the sensors of a named rig, by name, as given in its file.

    Args:
        name: NAME of `configs/rigs/NAME.yaml`, or a YAML file, relative or absolute.
        base_dir: folder that a relative path starts from; None: the working directory.

    Raises:
        ConfigError: no rig has that name, or its file has no mapping.
    """
    from cavmarl.config.io import read_yaml

    path = _find_rig(name, Path() if base_dir is None else base_dir)
    sensors = read_yaml(path)
    if not isinstance(sensors, dict):
        raise ConfigError(f"{path}: must be a mapping of sensors by name")
    return sensors


def _find_rig(name: str, base_dir: Path) -> Path:
    if name.endswith((".yaml", ".yml")):
        return base_dir / name
    rigs = {path.stem: path for place in places("configs") for path in place.glob("rigs/*.yaml")}
    if name not in rigs:
        raise ConfigError(
            f"rig = {name!r}: no such rig; give one of {', '.join(sorted(rigs)) or 'none'}, or the "
            "path of a file that ends in .yaml"
        )
    return rigs[name]


def is_converted(source: str) -> bool:
    """Return whether a source in `map.source` is a map file that is converted to a network."""
    return source.endswith((*MAP_SUFFIXES, *SCENE_SUFFIXES)) and not source.endswith(_NATIVE)


def resolve_maps(config: EnvConfig, base_dir: Path) -> list[Path]:
    """Return the files of `map.source`; those of a folder are sorted by name.

    Raises MapError if files are missing (the message lists all) or a folder has no map file.
    """
    found: list[Path] = []
    refused: list[str] = []
    for source in config.map.sources:
        try:
            found += _maps_of(source, base_dir)
        except MapError as error:
            refused.append(str(error))
    if refused:
        raise MapError("\n".join(refused))
    return found


def resolve_map(config: EnvConfig, base_dir: Path) -> Path:
    """Return the file of `map.source`, which must be a single file.

    Raises MapError as `resolve_maps` does, or if there are several files.
    """
    found = resolve_maps(config, base_dir)
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise MapError(f"map.source has {len(found)} maps: {names}; name one of them")
    return found[0]


def _maps_of(source: str, base_dir: Path) -> list[Path]:
    if source.startswith(SUMO_PREFIX) or not isdir(base_dir / source):
        return [_resolve("map.source", source, base_dir, MapError)]
    names = sorted(path.name for path in (base_dir / source).iterdir())
    maps = [base_dir / source / name for name in names if name.endswith(MAP_SUFFIXES)]
    if not maps:
        raise MapError(
            f"map.source = {source!r}: no map file in {base_dir / source}; a map must end in "
            f"{' or '.join(MAP_SUFFIXES)}"
        )
    return maps


def resolve_demand(config: EnvConfig, base_dir: Path) -> list[Path]:
    """Return the files of `traffic.demand`; paths as in `map.source`."""
    return [
        _resolve("traffic.demand", source, base_dir, DemandError)
        for source in config.traffic.demand
    ]


def resolve_programs(config: EnvConfig, base_dir: Path) -> list[Path]:
    """Return the files of `map.programs`; arguments and errors as for `resolve_map`."""
    return [_resolve("map.programs", source, base_dir, MapError) for source in config.map.programs]


def resolve_buildings(config: EnvConfig, base_dir: Path) -> Path | None:
    """Return the file of `map.buildings`, or None if the key is empty; raises as `resolve_map`."""
    match config.map.buildings:
        case "":
            return None
        case "osm":
            return resolve_map(config, base_dir)
        case source:
            return _resolve("map.buildings", source, base_dir, MapError)


def resolve_zones(config: EnvConfig, base_dir: Path) -> Path | None:
    """Return the zone file in `zones.layout`, or None for a division method; raises ConfigError."""
    layout = config.zones.layout
    if layout in ZONE_LAYOUTS:
        return None
    return _resolve("zones.layout", layout, base_dir, ConfigError)


def _resolve(key: str, source: str, base_dir: Path, failure: type[CavmarlError]) -> Path:
    if source.startswith(SUMO_PREFIX):
        home = Path(require("sumo", "sumo").SUMO_HOME).resolve()
        path = (home / source.removeprefix(SUMO_PREFIX)).resolve()
        if not path.is_relative_to(home):
            raise failure(f"{key} = {source!r}: must be inside of the eclipse-sumo wheel")
    else:
        path = base_dir / source
    if not isfile(path):
        raise failure(f"{key} = {source!r}: no file {path}; give the path of a file")
    return path


def _collect(kind: str, name_of: Callable[[Path], str | None]) -> dict[str, Path]:
    """Return name → path of all entries of `kind`, sorted by name; the first place wins."""
    return dict(sorted(_named(reversed(places(kind)), name_of).items()))


def _named(folders: Iterable[Path], name_of: Callable[[Path], str | None]) -> dict[str, Path]:
    return {
        name: path
        for place in folders
        for path in _listed(place)
        if (name := name_of(path)) is not None
    }


def _listed(place: Path) -> list[Path]:
    """Return the files in a folder that have printable names; none if it cannot be read."""
    try:
        return [path for path in place.iterdir() if path.name.isprintable()]
    except OSError:
        return []


def _environment_name(path: Path) -> str | None:
    return path.name if isfile(path / "env.yaml") else None


def _agent_name(path: Path) -> str | None:
    if path.suffix == ".py" and not path.name.startswith("_"):
        return path.stem
    return path.name if isfile(path / "model.safetensors") else None


def _advice(env: str | Path, known: Mapping[str, Path]) -> str:
    """Return similar names, if any, and all known names."""
    close = difflib.get_close_matches(str(env), known, n=3)
    meant = f"did you mean {' or '.join(close)}? " if close else ""
    return f"{meant}Environments: {', '.join(known) or 'none'}"


def _map_name(path: Path) -> str:
    """Return a map file's name without its suffix."""
    suffixes = (*MAP_SUFFIXES, SUMO_CONFIG_SUFFIX, *SCENE_SUFFIXES)
    ending = max((s for s in suffixes if path.name.endswith(s)), key=len, default="")
    return path.name.removesuffix(ending)


def shadow(raw: dict[str, Any], key: str, value: object) -> None:
    """Set the value at a dotted key of nested mappings."""
    *parents, last = key.split(".")
    inner: Any = raw
    for depth, parent in enumerate(parents):
        inner = inner.setdefault(parent, {})
        if not isinstance(inner, dict):
            raise ConfigError(f"{key}: {'.'.join(parents[: depth + 1])} has no keys inside it")
    inner[last] = value


def _horizon_s(max_cycles: int, raw: Mapping[str, Any]) -> object:
    """Return the horizon of `max_cycles` steps; unchanged if the step has no valid duration."""
    whole = isinstance(max_cycles, (int, np.integer)) and not isinstance(max_cycles, bool)
    if not whole or max_cycles < 1:
        raise ConfigError(f"max_cycles = {max_cycles!r}: must be a whole number, at least 1")
    step_s = raw["clock"].get("ctrl_dt_s") if isinstance(raw["clock"], Mapping) else None
    return int(max_cycles) * step_s if isinstance(step_s, (int, float)) else raw["horizon_s"]
