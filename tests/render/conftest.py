"""Fixtures: small maps of environments, and vehicles to draw."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.config.registry import load_config, resolve_map
from cavmarl.driving.vehicles import blank_vehicle
from cavmarl.roads.cache import load_network
from cavmarl.roads.network import RoadNetwork


@pytest.fixture(scope="session")
def ring() -> RoadNetwork:
    return load_network(resolve_map(*load_config("ring")))


@pytest.fixture(scope="session")
def grid() -> RoadNetwork:
    return load_network(resolve_map(*load_config("grid4x4")))


@pytest.fixture
def car() -> Callable[..., NDArray[np.void]]:
    """Return a function that makes a row of a vehicle: `car(x=3.0, agent=1)`."""

    def make(**fields: float) -> NDArray[np.void]:
        row = blank_vehicle()
        for name, value in fields.items():
            row[name] = value
        return row

    return make
