"""Buildings of the map weaken messages."""

from __future__ import annotations

from cavmarl import make_vec
from cavmarl.verify.equivalence import verify_zones

CHANNEL = {
    "v2x.enabled": True,
    "v2x.channel.path_loss_exponent": 2.75,
    "v2x.channel.building_db": 60.0,
}
BUILT = {"map.buildings": "map/buildings.poly.xml"}


def reception_ratio(**more: object) -> float:
    vec = make_vec("grid4x4", overrides=CHANNEL | more)
    vec.reset(seed=2)
    for _ in range(5):
        vec.step(vec.suggest_actions())
    messages = vec.simulation.messages
    assert messages is not None
    return messages.statistics().reception_ratio


def test_buildings_of_the_map_weaken_messages() -> None:
    assert reception_ratio(**BUILT) < 0.8 * reception_ratio()


def test_buildings_weaken_messages_in_divided_worlds() -> None:
    found = verify_zones("grid4x4", (4,), steps=10, overrides=CHANNEL | BUILT)
    assert all(result.difference is None for result in found.results)
