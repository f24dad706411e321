from __future__ import annotations

from pathlib import Path

import pytest

from cavmarl.registry import entries, load_config
from cavmarl.shard.sensors import SENSORS, layout
from cavmarl.spaces import flat_observation_space, observation_table
from tests.generated import check_block

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize("name", sorted(entries()))
def test_a_card_has_the_observation_index_by_index(name: str) -> None:
    config, base_dir = load_config(name)
    check_block(base_dir / "README.md", "observation table", observation_table(config.sensors))


@pytest.mark.parametrize("name", sorted(entries()))
def test_a_card_shows_its_world(name: str) -> None:
    _, base_dir = load_config(name)
    assert f"](../../docs/images/{name}.png)" in (base_dir / "README.md").read_text("utf-8")
    assert (ROOT / "docs" / "images" / f"{name}.png").stat().st_size > 5_000


@pytest.mark.parametrize("name", sorted(entries()))
def test_the_layout_covers_the_observation_without_gaps(name: str) -> None:
    config, _ = load_config(name)
    places = list(layout(config.sensors).values())
    assert [place.start for place in places] == [0, *(place.stop for place in places[:-1])]
    assert flat_observation_space(config).shape == (places[-1].stop,)
    assert places[-1].stop == sum(len(sensor.features(config.sensors)) for sensor in SENSORS)
