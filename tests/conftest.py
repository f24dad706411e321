"""Fixtures that all tests share."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.cpu_time import CpuTimes


def pytest_configure(config: pytest.Config) -> None:
    """Count what the tests cost."""
    config.pluginmanager.register(CpuTimes(), "cpu_times")


@pytest.fixture(scope="session")
def shared_maps() -> Path:
    """The folder of real maps, which is not part of the repository."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "maps"
    folder = Path(os.environ.get("CAVMARL_SHARED_MAPS", beside))
    if not folder.is_dir():
        pytest.skip(f"no real maps in {folder}: set CAVMARL_SHARED_MAPS to their folder")
    return folder


@pytest.fixture(scope="session")
def built_map(shared_maps: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """SUMO networks of the real maps, each built once, tolerantly: `built_map("osm/x.osm")`."""
    from cavmarl.maps.netconvert import build_network

    folder = tmp_path_factory.mktemp("built")

    def build(name: str) -> Path:
        target = folder / f"{name.replace('/', '-')}.net.xml"
        if not target.exists():
            build_network(shared_maps / name, target, tolerant=True)
        return target

    return build
