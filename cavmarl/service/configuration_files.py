"""Files of a configuration: an environment and drivers that a client has uploaded as artefacts.

A configuration maps relative paths ("places") to files. `drivers/NAME/` has the two files of a
trained driver; the other files belong to the environment.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from cavmarl.client.uploads import DRIVER_FILES, DRIVER_FOLDER, ENVIRONMENT_FILE
from cavmarl.config.env import EnvConfig
from cavmarl.config.io import read_yaml
from cavmarl.config.registry import MAP_SUFFIXES, load_config
from cavmarl.config.traffic import ZOO
from cavmarl.core.errors import CavmarlError
from cavmarl.service.artefacts import is_same_kind
from cavmarl.service.error_names import problem
from cavmarl.service.service_records import ArtefactRecord

_PLAIN = re.compile(r"[A-Za-z0-9_+:#,() -]{0,64}")
_INSTALLED_MAP = re.compile(r"sumo:[A-Za-z0-9_-]+(/[A-Za-z0-9_-]+)*(\.[A-Za-z0-9_-]+)+")
YAML = ".yaml"  # the only files that the service reads itself
# All YAML files of a configuration, 256 KiB. The limit is low because reading YAML is slow: about
# one second per 64 KiB.
MOST_YAML_BYTES = 1 << 18
MOST_FILES_BYTES = 1 << 30  # all files of a configuration, which a node keeps for each session
_RESERVED = ("agents", "configs", "envs", "runs")  # folders of installed entries and of runs
_OF_OTHERS = ("zones.journal", "zones.simulators", "workers.key_file")


def drivers_of(files: Mapping[str, str]) -> list[str]:
    """Return the names of the uploaded drivers of a configuration."""
    prefix = f"{DRIVER_FOLDER}/"
    return sorted({place.split("/")[1] for place in files if place.startswith(prefix)})


def has_environment(environment: str, files: Mapping[str, str]) -> bool:
    """Return whether the environment of a configuration was uploaded."""
    return ENVIRONMENT_FILE in files or environment in files


def environment_of(environment: str, files: Mapping[str, str], folder: str | Path) -> str:
    """Return the folder or map file of an uploaded environment, or the name of an installed one.

    `folder`: the folder with the files of the configuration.
    """
    if ENVIRONMENT_FILE in files:
        return str(folder)
    return str(Path(folder) / environment) if environment in files else environment


def check_files(environment: str, files: Mapping[str, str]) -> None:
    """Check the relative paths of the files of a configuration.

    Raises:
        ServiceError: a driver is incomplete, or a file belongs neither to a driver nor to the
            environment.
    """
    for name in drivers_of(files):
        there = sorted(place.split("/", 2)[2] for place in files if _is_of_driver(place, name))
        if there != sorted(DRIVER_FILES):
            raise problem(
                "refused",
                f"files: driver '{name}' has {', '.join(there)}: it must have exactly "
                f"{' and '.join(DRIVER_FILES)}",
            )
    is_environment = has_environment(environment, files)
    if environment in files and not environment.endswith(MAP_SUFFIXES):
        raise problem(
            "refused",
            f"environment: the uploaded file {environment} is not a map: give a map, or the "
            "name of an environment",
        )
    for place in files:
        top = place.split("/")[0]
        if top in _RESERVED and top != place:
            raise problem(
                "refused",
                f"files: {place}: the folder name {top} is reserved, like all of "
                f"{', '.join(_RESERVED)}: rename the folder",
            )
        if top != DRIVER_FOLDER and not is_environment:
            raise problem(
                "refused", f"files: {place} belongs to no environment: add {ENVIRONMENT_FILE}"
            )


def _is_of_driver(place: str, name: str) -> bool:
    return place.startswith(f"{DRIVER_FOLDER}/{name}/")


def check_artefacts(files: Mapping[str, str], own: Mapping[str, ArtefactRecord]) -> None:
    """Check the sizes of files, and that the suffix of each path fits the content.

    Args:
        files: hashes by relative path.
        own: artefacts by hash; the content of each was checked to fit the suffix of its name.

    Raises:
        ServiceError: the suffix of a path does not fit the content, or the files are too large.
    """
    for place, sha256 in files.items():
        if not is_same_kind(place, own[sha256].name):
            raise problem(
                "refused",
                f"files: {place} was uploaded as {own[sha256].name}, a file of another kind: "
                "upload it again with a name that has the suffix of its place",
            )
    sizes = {place: own[sha256].size_bytes for place, sha256 in files.items()}
    read = sum(size for place, size in sizes.items() if place.endswith(YAML))
    for what, size, most in (
        ("files", sum(sizes.values()), MOST_FILES_BYTES),
        ("YAML files", read, MOST_YAML_BYTES),
    ):
        if size > most:
            raise problem(
                "refused",
                f"files: all {what} together have {size} bytes: at most {most}; remove some",
            )


def load_uploaded(
    environment: str, files: Mapping[str, bytes], keys: Mapping[str, Any]
) -> EnvConfig:
    """Return the configuration of an uploaded environment; `files`: content by relative path.

    Only the content of YAML files is needed.

    Raises:
        ServiceError: it names a file that was not uploaded, or code.
        ConfigError: a key or a value is not allowed.
    """
    with TemporaryDirectory(prefix="cavmarl-check-") as folder:
        for place, content in files.items():
            path = Path(folder) / place
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
            if place.endswith(YAML):
                _check_yaml(place, read_yaml(path), files)
        where = environment_of(environment, dict.fromkeys(files, ""), folder)
        try:
            config = load_config(where, **keys)[0]
        except CavmarlError as error:
            raise problem("refused", str(error).replace(f"{folder}/", "")) from error
    found = asdict(config)
    for key in _OF_OTHERS:
        section, _, name = key.partition(".")
        if found[section][name] if name else found[section]:
            raise problem("refused", f"{key}: an uploaded environment must not set it; remove it")
    return config


def _check_yaml(place: str, found: Any, files: Mapping[str, Any]) -> None:
    """Refuse modules, which are code and would be imported, and files of the node."""
    if place == ENVIRONMENT_FILE and isinstance(found, dict) and "plugins" in found:
        raise problem(
            "refused",
            "plugins: its entries name modules, which are code; an uploaded environment must not "
            "have the key",
        )
    _check_texts(place, found, files)


def _check_texts(place: str, value: Any, files: Mapping[str, Any]) -> None:
    """Refuse texts that could name a file of the node."""
    if isinstance(value, str):
        is_known = value in files or _INSTALLED_MAP.fullmatch(value)
        if not is_known and not _PLAIN.fullmatch(value.removeprefix(ZOO)):
            raise problem(
                "refused",
                f"{place}: {value[:64]!r} could name a file that was not uploaded: upload it, or "
                "use only letters, digits, _, + and -",
            )
    elif isinstance(value, dict):
        for key, one in value.items():
            _check_texts(place, key, files)
            _check_texts(place, one, files)
    elif isinstance(value, list):
        for one in value:
            _check_texts(place, one, files)


def placed_policies(policies: Sequence[str], files: Mapping[str, str], folder: str) -> list[str]:
    """Return the drivers of a job, with the folder of an uploaded driver in place of its name."""
    own = drivers_of(files)
    return [str(Path(folder, DRIVER_FOLDER, name)) if name in own else name for name in policies]


def placed_overrides(
    environment: str, keys: Mapping[str, Any], files: Mapping[str, str], folder: str
) -> dict[str, Any]:
    """Return overrides that replace names of uploaded drivers in `traffic.model` by their paths."""
    own = drivers_of(files)
    if not own:
        return {}
    model = load_config(environment, **keys)[0].traffic.model
    shares = {model: 1.0} if isinstance(model, str) else model
    if not any(name.removeprefix(ZOO) in own for name in shares if name.startswith(ZOO)):
        return {}
    return {
        "traffic.model": {
            f"{ZOO}{Path(folder, DRIVER_FOLDER, name.removeprefix(ZOO))}"
            if name.startswith(ZOO) and name.removeprefix(ZOO) in own
            else name: share
            for name, share in shares.items()
        }
    }
