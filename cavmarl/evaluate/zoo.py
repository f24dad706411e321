"""The zoo: trained drivers with results that can be verified by repeating the evaluation.

An entry is the folder of a trained driver with a folder `result/`: a finished evaluation of
`cavmarl evaluate`, whose manifest lists the hashes of the results. To verify an entry, its
evaluation is repeated and the bytes are compared.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.driver_names import TOGETHER
from cavmarl.config.registry import agent_entries
from cavmarl.config.removed_keys import removed_key
from cavmarl.config.sensors import SensorsConfig
from cavmarl.config.world_spec import WorldKeys, WorldSpec
from cavmarl.core.errors import CavmarlError, ConfigError, ManifestError, PolicyError
from cavmarl.core.machine import describe_hardware
from cavmarl.engine.world_description import describe_world
from cavmarl.engine.world_setup import load_world
from cavmarl.evaluate.episodes import Progress
from cavmarl.evaluate.evaluation import (
    EPISODES_FILE,
    TRACKS_FILE,
    TRIPS_FILE,
    evaluate,
    load_tables,
    read_evaluation,
    run_seeds,
)
from cavmarl.evaluate.provenance.manifest import hash_of_file
from cavmarl.networks.network_files import read_network_config
from cavmarl.policies.loading import policy_files
from cavmarl.roads.road_kinds import RoadKind
from cavmarl.sensors.observed.feature import Reading
from cavmarl.sensors.observed.readings import readings_of

RESULT_FOLDER = "result"
TABLES = (TRIPS_FILE, EPISODES_FILE, TRACKS_FILE)  # files whose bytes are reproducible
SHARES = ("success", "collision", "off_road", "red_light")


@dataclass(frozen=True)
class ZooEntry:
    """A trained driver and its result."""

    name: str
    folder: Path
    weights_bytes: int
    environment: str  # name and version, for example `merge-v6`; empty: no result
    trips: int  # trips of the result
    shares: Mapping[str, float]  # shares of trips by the names of `SHARES`
    readings: tuple[Reading, ...] = ()  # what the driver reads, by source
    maps: tuple[RoadKind, ...] = ()  # kinds of the maps of its training
    refused: str = ""  # why the entry cannot be read, with the remedy; other fields are then empty


@dataclass(frozen=True)
class Verification:
    """An entry's result compared with a repetition of its evaluation.

    Attributes:
        name: name of the driver.
        expected: SHA-256 of each file of the result.
        found: SHA-256 of the files of this run.
        expected_on: processor on which the result was made.
        found_on: processor of this run.
    """

    name: str
    expected: Mapping[str, str]
    found: Mapping[str, str]
    expected_on: str
    found_on: str

    @property
    def differing(self) -> list[str]:
        """The files whose bytes differ from the result."""
        return [file for file, digest in self.expected.items() if self.found[file] != digest]


@dataclass(frozen=True)
class EntryJob:
    """The settings that repeat a result."""

    world: WorldSpec
    episodes: int
    repeats: int

    def drive(self, name: str, folder: Path, out: Path, progress: Progress | None = None) -> None:
        """Evaluate a driver into the new folder `out`; the tables contain its name."""
        evaluate(
            self.world,
            {name: folder},
            episodes=self.episodes,
            repeats=self.repeats,
            out=out,
            progress=progress,
        )


@dataclass(frozen=True)
class Cross:
    """Results of drivers among others: `tables[a][b]` are TRIP rows of a's vehicles among b's."""

    drivers: tuple[str, ...]
    tables: Mapping[str, Mapping[str, NDArray[np.void]]]

    def share(self, driver: str, others: str, column: str) -> float | None:
        """Return a share of a driver's counted trips among others; None: it had no trips."""
        trips = self.tables[driver][others]
        return float(trips[column].mean()) if len(trips) else None


def zoo_entries() -> list[ZooEntry]:
    """Return the named trained drivers; if a driver is unreadable, its entry states the reason."""
    return [_told(name, path) for name, path in sorted(agent_entries().items()) if path.is_dir()]


def verify_entry(policy: str | Path, progress: Progress | None = None) -> Verification:
    """Drive an entry's episodes again.

    Args:
        policy: name of a trained driver, or its folder.
        progress: as in `evaluate`.

    Raises:
        PolicyError: there is no such driver, or it is not trained.
        ManifestError: there is no result, or the weights or the world have changed since then.
    """
    folder = _trained(policy)[1]
    return verify_result(folder, folder, progress)


def verify_result(folder: Path, driver: Path, progress: Progress | None = None) -> Verification:
    """Drive the episodes of the result in a folder again.

    Args:
        folder: contains the result.
        driver: folder of the trained driver, or the script.
        progress: as in `evaluate`.

    Raises:
        PolicyError: the driver cannot be read.
        ManifestError: as `verify_entry`.
    """
    name = folder.name
    document = read_evaluation(folder / RESULT_FOLDER)
    job = entry_job(document, folder)
    check_weights(document, name, policy_files(driver))
    _check_world(document, name, job.world)
    with TemporaryDirectory() as room:
        out = Path(room) / "again"
        job.drive(next(iter(document["policies"])), driver, out, progress)
        known = document["results_sha256"]
        expected = {file: known[file] for file in TABLES if file in known}
        return Verification(
            name,
            expected,
            {file: hash_of_file(out / file) for file in expected},
            _processor(document.get("hardware", {})),
            _processor(describe_hardware()),
        )


def cross(
    env: str | Path | WorldSpec,
    policies: Sequence[str],
    *,
    episodes: int = 8,
    progress: Progress | None = None,
    **keys: Unpack[WorldKeys],
) -> Cross:
    """Evaluate each driver among the vehicles of each other driver.

    All pairs drive the same episodes. Agents with even numbers belong to the driver, agents with
    odd numbers to the other driver.

    Raises:
        ConfigError: the environment has fewer than two agents.
        PolicyError: a driver cannot be loaded, does not fit, or is named twice.
    """
    if len(set(policies)) < len(policies):
        raise PolicyError(f"drivers {', '.join(policies)}: one is listed twice; list each once")
    spec = WorldSpec.of(env, **keys)
    if load_world(spec.env, **spec.keywords).config.population.num_ids < 2:
        raise ConfigError(f"{spec.env}: has one agent; a comparison of drivers needs two or more")
    pairs = {(a, b): a if a == b else f"{a}{TOGETHER}{b}" for a in policies for b in policies}
    with TemporaryDirectory() as room:
        out = Path(room) / "cross"
        named = {f"{a} among {b}": pair for (a, b), pair in pairs.items()}
        evaluate(spec, named, episodes=episodes, out=out, progress=progress)
        found = load_tables(out)
    tables: dict[str, dict[str, NDArray[np.void]]] = {a: {} for a in policies}
    for a, b in pairs:
        trips, _ = found[f"{a} among {b}"]
        tables[a][b] = trips[trips["counted"] & (trips["agent"] % 2 == 0)]
    return Cross(tuple(policies), tables)


# Manifest keys that must be equal, besides the configuration. The map is compared by its source
# only: if this version reads it differently, the trips will show it.
_WORLD_KEYS = ("environment", "map_source_sha256", "demand_content_sha256")
_KEYS = ("agents", "background", "max_cycles", "seed", "overrides")


def zoo_entry(policy: str | Path) -> ZooEntry:
    """Return a trained driver with its result.

    Args:
        policy: name of a trained driver, or its folder.

    Raises:
        PolicyError: there is no such driver, or it is not trained.
        ManifestError: its result cannot be read.
    """
    return _entry(*_trained(policy))


def _trained(policy: str | Path) -> tuple[str, Path]:
    """Return the name and the folder of a trained driver.

    Raises PolicyError: there is no such driver, or it is not trained.
    """
    files = policy_files(policy)
    if len(files) < 2:
        raise PolicyError(f"{policy}: is a script; the zoo contains only trained drivers")
    return files[0].parent.name, files[0].parent


def _told(name: str, folder: Path) -> ZooEntry:
    try:
        return _entry(name, folder)
    except CavmarlError as error:
        return ZooEntry(name, folder, 0, "", 0, {}, refused=f"{name}: {error}")


def _entry(name: str, folder: Path) -> ZooEntry:
    weights_bytes = policy_files(folder)[0].stat().st_size
    config = read_network_config(folder)
    label = tuple(readings_of(config.sensors, config.residual)), config.maps
    result = folder / RESULT_FOLDER
    if not result.is_dir():
        return ZooEntry(name, folder, weights_bytes, "", 0, {}, *label)
    document = read_evaluation(result)
    trips, _ = load_tables(result)[next(iter(document["policies"]))]
    counted = trips[trips["counted"]]
    shares = {key: float(counted[key].mean()) for key in SHARES} if len(counted) else {}
    environment = document["world"]["environment"]
    return ZooEntry(name, folder, weights_bytes, environment, len(counted), shares, *label)


def _processor(hardware: Mapping[str, Any]) -> str:
    return f"{hardware.get('cpu', 'an unknown processor')} ({hardware.get('architecture')})"


def entry_job(document: Mapping[str, Any], folder: Path) -> EntryJob:
    """Return what is needed to repeat the result of a driver's folder.

    Args:
        document: manifest of the result.
        folder: folder of the driver.

    Raises:
        ManifestError: the manifest does not state how the result was made.
    """
    job = document.get("job")
    if (
        not isinstance(job, dict)
        or not {"env", "episodes", *_KEYS} <= job.keys()
        or not isinstance(job["overrides"], dict | None)
    ):
        raise ManifestError(
            f"{folder / RESULT_FOLDER}: its manifest does not say what was driven; make the result "
            f"again: `cavmarl evaluate ENV --policy {folder} --out {folder / RESULT_FOLDER}`"
        )
    world = WorldSpec.of(job["env"], **{key: job[key] for key in _KEYS})
    seeds = document["seeds"]
    driven = (job["episodes"], run_seeds(world.seed, len(seeds)))
    if driven != (document.get("episodes"), seeds):
        raise ManifestError(
            f"{folder / RESULT_FOLDER}: its manifest shows episodes or seeds that were not driven; "
            "evaluate the driver again"
        )
    return EntryJob(world, job["episodes"], len(seeds))


def check_weights(document: Mapping[str, Any], name: str, files: Sequence[Path]) -> None:
    """Raise ManifestError unless the result of a driver was made with these files."""
    (described,) = list(document["policies"].values())[:1]
    known = described.get("sha256") if isinstance(described, dict) else None
    for file in files:
        if not isinstance(known, dict) or known.get(file.name) != hash_of_file(file):
            raise ManifestError(
                f"{file}: is not the file that the result of {name} was made with; restore it, or "
                "evaluate the driver again"
            )


def _check_world(document: Mapping[str, Any], name: str, spec: WorldSpec) -> None:
    """Raise an error if the world is not that of the result; new and removed keys do not count."""
    here = json.loads(json.dumps(describe_world(*load_world(spec.env, **spec.keywords))))
    there = document["world"]
    try:
        others = _other_keys(here, there)
    except (LookupError, TypeError, AttributeError) as error:
        raise ManifestError(
            f"{name}: the manifest of its result describes no world ({type(error).__name__}: "
            f"{error}); evaluate the driver again"
        ) from error
    if others:
        raise ManifestError(
            f"{name}: its result is of {there['environment']}, but {others[0]} has another value "
            f"in this version ({here['environment']}); figures of different worlds are not "
            "compared: evaluate the driver again"
        )


def _other_keys(here: Mapping[str, Any], there: Mapping[str, Any]) -> list[str]:
    """Return the keys of a described world that differ from this version's."""
    ours = here["config"]
    differing = _differing("config", _without_idle_sensors(there["config"], ours), ours)
    others = [key for key in _WORLD_KEYS if here[key] != there[key]]
    return others + [key for key in differing if removed_key(key.removeprefix("config.")) is None]


def _without_idle_sensors(config: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """Return a described configuration without the sensors that are off in both."""
    switches = {name: own.switches for name, own in SensorsConfig().sections().items()}

    def is_on(described: Mapping[str, Any], name: str) -> bool:
        keys = described["sensors"].get(name, {})
        return name not in switches or any(keys.get(switch) for switch in switches[name])

    both = (config, other)
    names = [name for name in config["sensors"] if any(is_on(one, name) for one in both)]
    return {**config, "sensors": {name: config["sensors"][name] for name in names}}


def _differing(key: str, there: Any, here: Any) -> Iterator[str]:
    """Return keys of a config that have another value, or none, in the present config."""
    if isinstance(there, dict) and isinstance(here, dict):
        for name, value in there.items():
            yield from _differing(f"{key}.{name}", value, here.get(name))
    elif there != here:
        yield key
