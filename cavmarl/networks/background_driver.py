"""Trained drivers for background vehicles: which drivers are suitable, and why others are not.

A background vehicle carries its own state in its record, which zones hand over. Therefore, the
memory of its driver is limited to `MEMORY_FIELDS` of `driving.vehicles`: the controls and speeds of
the last steps. Drivers that need more are refused.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cavmarl.config.driver_form import CONFIG_FILE, WEIGHTS_FILE
from cavmarl.config.driver_names import find_driver
from cavmarl.config.registry import agent_entries
from cavmarl.config.sensors import SensorsConfig
from cavmarl.config.traffic import ZOO, TrafficConfig
from cavmarl.core.errors import PolicyError
from cavmarl.roads.road_kinds import RoadKind

if TYPE_CHECKING:
    from cavmarl.networks.network_files import NetworkConfig

MOST_STEPS = 3  # limit of the sensor `history`: the current step, and those of `MEMORY_FIELDS`


@dataclass(frozen=True)
class BackgroundDriver:
    """A trained driver that drives background vehicles.

    Attributes:
        name: its name or path, as `traffic.model` gives it.
        folder: its folder.
        sensors: the sensors that it observes.
        maps: kinds of the maps of its training.
        content_hash: SHA-256 of its weights and its configuration.
    """

    name: str
    folder: Path
    sensors: SensorsConfig
    maps: tuple[RoadKind, ...]
    content_hash: str


def background_drivers(traffic: TrafficConfig) -> tuple[BackgroundDriver, ...]:
    """Return the trained drivers that `traffic.model` names, ordered as `TrafficConfig.models`.

    Raises:
        PolicyError: a driver does not exist, its files are invalid, or it needs data that
            background vehicles do not have.
    """
    return tuple(map(_background_driver, traffic.networks))


def _background_driver(name: str) -> BackgroundDriver:
    if not name:
        raise PolicyError(f"traffic.model = '{ZOO}': names no driver; name one of {_allowed()}")
    try:
        folder = find_driver(name)
    except PolicyError as error:
        raise PolicyError(f"traffic.model = '{ZOO}{name}': {error}") from error
    if not folder.is_dir():
        raise PolicyError(
            f"traffic.model = '{ZOO}{name}': is a script or a model file, which acts through the "
            f"environment; background vehicles need a trained driver: {_allowed()}"
        )
    config = _read(name, folder)
    if reasons := list(_reasons_against(config)):
        raise PolicyError(
            f"traffic.model = '{ZOO}{name}': background vehicles cannot have this driver, because "
            f"{'; '.join(reasons)}. Name one of these drivers: {_allowed()}"
        )
    files = [folder / WEIGHTS_FILE, folder / CONFIG_FILE]
    content = hashlib.sha256(b"".join(hashlib.sha256(one.read_bytes()).digest() for one in files))
    return BackgroundDriver(name, folder, config.sensors, tuple(config.maps), content.hexdigest())


def _read(name: str, folder: Path) -> NetworkConfig:
    """Read the configuration of a driver, and check its weights."""
    from cavmarl.networks.network_files import read_network  # pydantic is slow to import

    try:
        return read_network(folder)[1]
    except PolicyError as error:
        raise PolicyError(f"traffic.model = '{ZOO}{name}': {error}") from error


def _reasons_against(config: NetworkConfig) -> Iterator[str]:
    """Yield why background vehicles cannot have a driver with this network."""
    sensors, messages = config.sensors, config.sensors.messages
    if config.residual:
        yield "it observes the action of the built-in driver (residual)"
    if config.action.kind != "continuous":
        yield f"its actions are choices (action.kind = {config.action.kind})"
    if sensors.stack > 1:
        yield f"it observes earlier frames (sensors.stack = {sensors.stack})"
    if sensors.history.steps > MOST_STEPS:
        steps = sensors.history.steps
        yield f"it observes {steps} steps (sensors.history.steps), and a vehicle keeps {MOST_STEPS}"
    if messages.objects or messages.events or messages.signal:
        yield "it observes messages (sensors.messages)"
    if sensors.conflicts.heard:
        yield "it observes vehicles known from messages (sensors.conflicts.heard)"
    if sensors.registered:
        yield f"it observes registered sensors ({', '.join(sensors.registered)})"


def _allowed() -> str:
    """Return the names of the bundled drivers that background vehicles can have."""
    names = [
        name
        for name, path in agent_entries().items()
        if path.is_dir() and not any(_reasons_against(_read(name, path)))
    ]
    return ", ".join(names) or "none is installed"
