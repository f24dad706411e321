"""Configurations of worlds: immutable, identified by hash, with numbered versions per name.

A configuration from the network refers to installed environments and drivers, or to files that its
owner has uploaded. It must not name other files or code, so its overrides must not change the keys
of its environment that have file names as values.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, NamedTuple

from cavmarl.config.registry import agent_entries, entries, load_config
from cavmarl.core.errors import CavmarlError, ServiceError
from cavmarl.service.artefacts import Artefacts
from cavmarl.service.configuration_files import (
    YAML,
    check_artefacts,
    check_files,
    drivers_of,
    environment_of,
    has_environment,
    load_uploaded,
    placed_overrides,
)
from cavmarl.service.error_names import problem
from cavmarl.service.event_log import EventLog
from cavmarl.service.request_bodies import ConfigurationBody
from cavmarl.service.service_records import IdentityRecord

MOST_CONFIGURATIONS = 10_000  # configurations of one identity
MOST_VEHICLES = 200_000  # in all worlds of a session, so that they fit into the memory of a node
_PLAIN = re.compile(r"[A-Za-z0-9_+:#,() -]{0,64}")
_OF_FILES = (
    "map.source",
    "map.programs",
    "map.buildings",
    "traffic.demand",
    "zones.journal",
)


class NewConfiguration(NamedTuple):
    """A configuration that is not stored yet."""

    name: str
    document: dict[str, Any]
    contents: dict[str, bytes]  # content of YAML files by relative path; b"" for other files

    def check(self) -> None:
        """Check the configuration; this takes seconds if it has many files.

        Raises:
            ServiceError: the configuration is refused.
        """
        _check(self.document, self.contents)


def collect_configuration(
    log: EventLog, identity: IdentityRecord, body: ConfigurationBody, artefacts: Artefacts
) -> NewConfiguration:
    """Return a configuration with the files that its check needs.

    Raises:
        ServiceError: a file is missing, is too large, or does not fit the suffix of its path.
    """
    document = body.model_dump(exclude={"name"})
    files: dict[str, str] = document["files"]
    if not files:
        del document["files"]  # so that configurations without files keep their hashes
    artefacts.use(identity, files.values())
    check_artefacts(files, artefacts.of(identity.id))
    contents = {
        place: log.content(sha256) if place.endswith(YAML) else b""
        for place, sha256 in files.items()
    }
    return NewConfiguration(body.name or body.environment, document, contents)


def add_configuration(
    log: EventLog, identity: IdentityRecord, new: NewConfiguration
) -> dict[str, Any]:
    """Store a configuration that was checked; equal content keeps its version."""
    name, document = new.name, new.document
    content = json.dumps(document, sort_keys=True, separators=(",", ":")).encode()
    found = hashlib.sha256(content).hexdigest()
    versions = log.state.configurations.get(name, [])
    if found not in versions:
        if log.state.configurations_of.get(identity.id, 0) >= MOST_CONFIGURATIONS:
            detail = f"you have {MOST_CONFIGURATIONS} configurations, the limit: use one of them"
            raise problem("too-many", detail)
        log.keep(content)
        data: dict[str, Any] = {"hash": found, "version": len(versions) + 1}
        if files := document.get("files"):
            data["files"] = sorted({*files.values()})
        log.record("configuration.added", name, data, actor=identity.id, owner=identity.id)
        versions = log.state.configurations[name]
    return {"name": name, "version": versions.index(found) + 1, "hash": found, **document}


def read_configuration(log: EventLog, sha256: str) -> dict[str, Any]:
    """Return the configuration with a hash; raise the problem `not-found` if there is none."""
    if not any(sha256 in versions for versions in log.state.configurations.values()):
        raise problem("not-found", f"there is no configuration {sha256}: add it first")
    document: dict[str, Any] = json.loads(log.content(sha256))
    return document


def check_policies(policies: list[str], files: Mapping[str, Any] | None = None) -> None:
    """Refuse texts that are not names of drivers, as a path could run code or name any folder.

    `files`: the files of the configuration, which include uploaded drivers.
    """
    known = [*agent_entries(), *drivers_of(files or {})]
    for policy in policies:
        if policy not in known:
            raise problem(
                "refused", f"there is no driver '{policy}': choose one of {', '.join(known)}"
            )


def world_of(
    document: dict[str, Any], folder: str, seen_as: str = ""
) -> tuple[str, dict[str, Any]]:
    """Return the environment and the keywords of `make_vec` and `evaluate` for a world.

    Args:
        document: the configuration.
        folder: the folder with its files.
        seen_as: path of that folder for the process that makes the world; empty: `folder`.
    """
    files, name = document.get("files", {}), document["environment"]
    keys = world_keywords(document)
    environment = environment_of(name, files, folder)
    seen_as = seen_as or folder
    keys["overrides"] |= placed_overrides(environment, keys, files, seen_as)
    return environment_of(name, files, seen_as), keys


def world_keywords(document: dict[str, Any]) -> dict[str, Any]:
    """Return the keywords of `make_vec` and `evaluate` that describe the world."""
    names = ("agents", "background", "max_cycles")
    zones = document.get("zones")
    divided = {} if zones is None else {"zones.count": zones}
    keys: dict[str, Any] = {name: document[name] for name in names}
    return keys | {"overrides": document["overrides"] | divided}


def _check(document: dict[str, Any], files: Mapping[str, bytes]) -> None:
    environment = document["environment"]
    hashes = document.get("files", {})
    check_files(environment, hashes)
    is_uploaded = has_environment(environment, hashes)
    if not is_uploaded and environment not in entries():
        known = ", ".join(entries())
        raise problem(
            "refused",
            f"there is no environment '{environment}': choose one of {known}, or upload your own",
        )
    for name in drivers_of(hashes):
        if name in agent_entries():
            raise problem("refused", f"files: the service has a driver '{name}': give another name")
    if "plugins" in document["overrides"]:
        raise problem(
            "refused",
            "plugins: its entries name modules, which are code, so the key cannot be overridden; "
            "the service and its nodes import only the modules that the env.yaml of an installed "
            "environment names",
        )
    for text in _texts(document["overrides"]):
        if not _PLAIN.fullmatch(text):
            raise problem(
                "refused",
                f"overrides: {text[:64]!r} could name a file: use only letters, digits, _, + and -",
            )
    keys = world_keywords(document)
    try:
        if is_uploaded:
            own = asdict(load_uploaded(environment, files, {}))
            config = load_uploaded(environment, files, keys)
        else:
            own = asdict(load_config(environment)[0])
            config = load_config(environment, **keys)[0]
    except ServiceError:
        raise
    except (CavmarlError, RecursionError) as error:
        raise problem("refused", str(error)) from error
    check_policies(list(config.traffic.networks), hashes)
    if refusal := config.refusal_of_agents("a session of the service"):
        raise problem("refused", refusal)
    population = config.population
    vehicles = document["num_envs"] * (
        population.num_ids
        + population.background
        + population.insertions
        + population.external
        + config.map.changed_lanes
    )
    if vehicles > MOST_VEHICLES:
        raise problem(
            "refused", f"{vehicles} vehicles and changed lanes in {document['num_envs']} worlds: "
            f"at most {MOST_VEHICLES}; reduce agents, background or num_envs"
        )  # fmt: skip
    wanted = asdict(config)
    for key in _OF_FILES:
        if _value(own, key) != _value(wanted, key):
            raise problem("refused", f"{key}: names files and cannot be overridden")


def _texts(value: Any) -> list[str]:
    """Return all text values of a nested document."""
    if isinstance(value, str):
        return [value]
    if isinstance(value, dict):
        return [text for one in value.values() for text in _texts(one)]
    if isinstance(value, list):
        return [text for one in value for text in _texts(one)]
    return []


def _value(config: dict[str, Any], key: str) -> Any:
    found: Any = config
    for part in key.split("."):
        found = found[part]
    return found
