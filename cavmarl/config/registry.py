"""The finder of entries: what stands in `envs/` and `agents/` is what there is.

A name is looked up in the working directory first, then in what the wheel carries, else beside the
package in a checkout. A path to a folder or to a map file works wherever a name does.
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
from cavmarl.config.scenario import path_of_code
from cavmarl.config.zones import ZONE_LAYOUTS
from cavmarl.core.errors import (
    CavmarlError,
    ConfigError,
    DemandError,
    MapError,
    UnknownEnvironmentError,
    require,
)

MAP_SUFFIXES = (".net.xml", ".net.xml.gz", ".osm", ".osm.gz", ".osm.xml", ".xodr")

PACKAGE = Path(__file__).resolve().parents[1]
_SUMO_PREFIX = "sumo:"


def places(kind: str) -> list[Path]:
    """The folders that hold entries of `kind` (`envs`, `agents`, `configs`), first wins."""
    return [place for place in (Path.cwd() / kind, _ours(kind)) if place.is_dir()]


def _ours(kind: str) -> Path:
    """Where the wheel has it, else the checkout."""
    packaged = PACKAGE / "data" / kind
    return packaged if packaged.is_dir() else PACKAGE.parent / kind


def entries() -> dict[str, Path]:
    """Every environment that a name can mean: name → its folder, sorted by name."""
    return _collect("envs", _environment_name)


def agent_entries() -> dict[str, Path]:
    """Every driver that a name can mean: name → `NAME.py`, or the folder of a trained one.

    In the working directory's `agents/` these are trained ones with names of their own: a script
    that lies there is run by its path alone.
    """
    own = {name: path for name, path in _collect("agents", _agent_name).items() if path.is_dir()}
    ours = places("agents")[-1:]
    return dict(sorted((own | _named(ours, _agent_name)).items()))


def programs() -> dict[str, Path]:
    """The training programs: name → `train/NAME.py`; those of the working directory are not it."""
    ours = _ours("train")
    return {path.stem: path for path in sorted(ours.glob("*.py"))}


def agent_here(name: str) -> Path | None:
    """What lies under the name of a driver in the working directory, if it is not that driver."""
    for path in (Path.cwd() / "agents" / f"{name}.py", Path.cwd() / "agents" / name):
        is_driver = isfile(path) if path.suffix == ".py" else _agent_name(path) is not None
        if is_driver and agent_entries().get(name) != path:
            return path
    return None


def find_entry(env: str | Path) -> Path:
    """The entry folder or the map file that `env` means.

    Args:
        env: a name from `entries()`, a folder with an `env.yaml`, or a map file.

    Raises:
        UnknownEnvironmentError: nothing there; the message says what there is.
    """
    if not isinstance(env, (str, Path)):
        raise UnknownEnvironmentError(
            f"env = {env!r}: must be the name of an environment, or the path of a folder or a map"
        )
    known = entries()
    if isinstance(env, str) and env in known:
        return known[env]
    path = Path(env)
    if isfile(path / "env.yaml"):  # unlike Path's, it takes names that no file can have
        return path
    if isfile(path):
        if not path.name.endswith(MAP_SUFFIXES):
            raise UnknownEnvironmentError(
                f"{path}: not a map file; their names end in {', '.join(MAP_SUFFIXES)}"
            )
        return path
    if isdir(path):
        raise UnknownEnvironmentError(f"{path}: a folder without an env.yaml")
    raise UnknownEnvironmentError(
        f"no environment, folder or map file '{env}'; {_advice(env, known)}"
    )


def load_config(
    env: str | Path,
    *,
    zones: int | None = None,
    sensor_workers: int | None = None,
    agents: int | None = None,
    background: int | None = None,
    max_cycles: int | None = None,
    overrides: Mapping[str, object] | None = None,
) -> tuple[EnvConfig, Path]:
    """The configuration of an environment, and the folder that its map's source is relative to.

    Args:
        env: what `find_entry` takes; a map file gets a default environment, whose horizon
            follows the map: see `make_world`.
        zones: shadows `zones.count`.
        sensor_workers: shadows `workers.sensors`.
        agents: shadows `population.agents`.
        background: shadows `population.background`.
        max_cycles: shadows `horizon_s`, in steps: exactly that many.
        overrides: dotted key → value, for every other key: `{"sensors.lidar.rays": 64}`. As in an
            env.yaml, `rig` may be the name of a rig in `configs/rigs`, or of a file.

    Raises:
        UnknownEnvironmentError: nothing of that name.
        ConfigError: a key, a type or a value that cannot work, with the nearest that can.
    """
    from cavmarl.config.io import read_yaml, validate

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
        config = EnvConfig(
            name=_map_name(found), map=MapConfig(source=found.name), horizon_s=BY_MAP
        )
    keywords = {
        "zones.count": zones,
        "workers.sensors": sensor_workers,
        "population.agents": agents,
        "population.background": background,
        "horizon_s": max_cycles,
    }
    given = {key: value for key, value in keywords.items() if value is not None}
    if not isinstance(overrides, Mapping | None):
        raise ConfigError(f"overrides = {overrides!r}: must be a mapping of dotted keys")
    shadows = dict(overrides or {})
    if strange := [key for key in shadows if not isinstance(key, str)]:
        raise ConfigError(f"overrides: {strange[0]!r} is no key; keys are text, dotted")
    if twice := given.keys() & shadows.keys():
        raise ConfigError(f"{min(twice)} stands in overrides and is given as a keyword; use one")
    shadows |= {key: value for key, value in given.items() if key != "horizon_s"}
    if shadows or max_cycles is not None:
        raw = dataclasses.asdict(config)
        for key, value in shadows.items():
            is_named = key == "rig" and isinstance(value, str)
            shadow(raw, key, load_rig(str(value), base_dir) if is_named else value)
        if max_cycles is not None:
            raw["horizon_s"] = _horizon_s(max_cycles, raw)
        config = validate(EnvConfig, raw, f"{where}, overridden")
    return config, base_dir


def find_settings(what: str, name: str) -> Path:
    """The file that `name` means: a path, or a name in `configs/`: a `rig`, `suite` or `train`."""
    if Path(name).is_file():
        return Path(name)
    folder, usual = {
        "rig": ("rigs", "ten_sensors"), "suite": ("suites", "standard"), "train": ("train", "merge")
    }[what]  # fmt: skip
    for place in places("configs"):
        path = place / folder / f"{name}.yaml"
        if path.is_file():
            return path
    raise ConfigError(f"no {what} or file '{name}': give '{usual}' or the path of a .yaml")


def _refuse_code(keys: object, where: str) -> None:
    """A folder of data does not run code: only the caller can name a file of it."""
    scenario = keys.get("scenario") if isinstance(keys, dict) else None
    name = scenario.get("name") if isinstance(scenario, dict) else None
    if isinstance(name, str) and path_of_code(name):
        raise ConfigError(
            f"{where}: scenario.name = {name!r}: is code, which a folder of data does not run; if "
            f"you trust it, say so: overrides={{'scenario.name': {name!r}}}, or --set scenario.name"
        )


def load_rig(name: str, base_dir: Path | None = None) -> dict[str, Any]:
    """The sensors of a rig that is named, by name, as they stand in its file.

    Args:
        name: of `configs/rigs/NAME.yaml`, or a YAML file, relative or absolute.
        base_dir: the folder that a relative file starts from; None: the working directory.

    Raises:
        ConfigError: there is none of that name, or no mapping in it.
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
            f"rig = {name!r}: no such rig; there are {', '.join(sorted(rigs)) or 'none'}; or name "
            "a file that ends in .yaml"
        )
    return rigs[name]


def resolve_maps(config: EnvConfig, base_dir: Path) -> list[Path]:
    """The files that `map.source` means; those of a folder in the order of their names.

    Raises MapError: what is missing, all of it; a folder without a map file.
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
    """The file that `map.source` means, where it is to be one.

    Raises MapError: as of `resolve_maps`, or there are several.
    """
    found = resolve_maps(config, base_dir)
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise MapError(f"map.source has {len(found)} maps: {names}; name the one that is meant")
    return found[0]


def _maps_of(source: str, base_dir: Path) -> list[Path]:
    if source.startswith(_SUMO_PREFIX) or not isdir(base_dir / source):
        return [_resolve("map.source", source, base_dir, MapError)]
    names = sorted(path.name for path in (base_dir / source).iterdir())
    maps = [base_dir / source / name for name in names if name.endswith(MAP_SUFFIXES)]
    if not maps:
        raise MapError(f"map.source = {source!r}: no map file in {base_dir / source}")
    return maps


def resolve_demand(config: EnvConfig, base_dir: Path) -> list[Path]:
    """The files that `traffic.demand` means, as `map.source` is resolved."""
    return [
        _resolve("traffic.demand", source, base_dir, DemandError)
        for source in config.traffic.demand
    ]


def resolve_programs(config: EnvConfig, base_dir: Path) -> list[Path]:
    """The files that `map.programs` means; arguments and errors as for `resolve_map`."""
    return [_resolve("map.programs", source, base_dir, MapError) for source in config.map.programs]


def resolve_buildings(config: EnvConfig, base_dir: Path) -> Path | None:
    """The file that `map.buildings` means; None: no buildings. Else as `resolve_map`."""
    match config.map.buildings:
        case "":
            return None
        case "osm":
            return resolve_map(config, base_dir)
        case source:
            return _resolve("map.buildings", source, base_dir, MapError)


def resolve_zones(config: EnvConfig, base_dir: Path) -> Path | None:
    """The zone file that `zones.layout` means; None where it is no file. Else as `resolve_map`."""
    layout = config.zones.layout
    if layout in ZONE_LAYOUTS:
        return None
    return _resolve("zones.layout", layout, base_dir, ConfigError)


def _resolve(key: str, source: str, base_dir: Path, failure: type[CavmarlError]) -> Path:
    if source.startswith(_SUMO_PREFIX):
        home = Path(require("sumo", "sumo").SUMO_HOME).resolve()
        path = (home / source.removeprefix(_SUMO_PREFIX)).resolve()
        if not path.is_relative_to(home):
            raise failure(f"{key} = {source!r}: leads out of the eclipse-sumo wheel")
    else:
        path = base_dir / source
    if not isfile(path):
        raise failure(f"{key} = {source!r}: no file {path}")
    return path


def _collect(kind: str, name_of: Callable[[Path], str | None]) -> dict[str, Path]:
    """Name → path of all entries of `kind`, sorted by name; of equal names the first place wins."""
    return dict(sorted(_named(reversed(places(kind)), name_of).items()))


def _named(folders: Iterable[Path], name_of: Callable[[Path], str | None]) -> dict[str, Path]:
    return {
        name: path
        for place in folders
        for path in _listed(place)
        if (name := name_of(path)) is not None
    }


def _listed(place: Path) -> list[Path]:
    """What lies in a folder and can be named; nothing of one that cannot be read."""
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
    """What was probably meant by an unknown name, and what there is."""
    close = difflib.get_close_matches(str(env), known, n=3)
    meant = f"did you mean {' or '.join(close)}? " if close else ""
    return f"{meant}There are: {', '.join(known) or 'none'}"


def _map_name(path: Path) -> str:
    """A map file's name without its ending."""
    ending = max((s for s in MAP_SUFFIXES if path.name.endswith(s)), key=len)
    return path.name.removesuffix(ending)


def shadow(raw: dict[str, Any], key: str, value: object) -> None:
    """Put `value` at a dotted key of nested mappings."""
    *parents, last = key.split(".")
    inner: Any = raw
    for depth, parent in enumerate(parents):
        inner = inner.setdefault(parent, {})
        if not isinstance(inner, dict):
            raise ConfigError(f"{key}: {'.'.join(parents[: depth + 1])} has no keys inside")
    inner[last] = value


def _horizon_s(max_cycles: int, raw: Mapping[str, Any]) -> object:
    """The horizon of `max_cycles` steps; of an impossible step, whatever stands there."""
    whole = isinstance(max_cycles, (int, np.integer)) and not isinstance(max_cycles, bool)
    if not whole or max_cycles < 1:
        raise ConfigError(f"max_cycles = {max_cycles!r}: must be a whole number from 1")
    step_s = raw["clock"].get("ctrl_dt_s") if isinstance(raw["clock"], Mapping) else None
    return int(max_cycles) * step_s if isinstance(step_s, (int, float)) else raw["horizon_s"]
