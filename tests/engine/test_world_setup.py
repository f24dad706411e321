"""From a configuration to what its world is made of."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from cavmarl.config.env import EnvConfig, ZonesConfig
from cavmarl.config.registry import load_config
from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_setup import load_roads, load_zones
from cavmarl.zones.partition.zone_file import write_zones
from cavmarl.zones.partition.zone_layouts import cut_map


def ring(layout: str) -> tuple[EnvConfig, Path]:
    config, folder = load_config("ring")
    return replace(config, zones=ZonesConfig(layout=layout)), folder


def test_zones_are_cut_by_name() -> None:
    config, folder = ring("bisection")
    network = load_roads(config, folder)
    assert load_zones(config, folder, network).count == 1


def test_zones_are_read_from_a_file_beside_the_entry(tmp_path: Path) -> None:
    config, folder = ring("zones.json")
    network = load_roads(config, folder)
    with pytest.raises(ConfigError, match=r"zones\.layout = 'zones\.json': no file"):
        load_zones(config, tmp_path, network)
    written = cut_map(network, "grid", 1)
    write_zones(tmp_path / "zones.json", written)
    assert load_zones(config, tmp_path, network).content_hash == written.content_hash
    write_zones(tmp_path / "zones.json", cut_map(network, "grid", 4))
    with pytest.raises(ConfigError, match=r"zones\.count = 1: .* has 4 zones; use 4"):
        load_zones(config, tmp_path, network)
