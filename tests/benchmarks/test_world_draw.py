"""Randomly drawn worlds depend only on their seeds, and their files have the drawn features."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

from benchmarks.world_draw import (
    FEATURES,
    JUNCTIONS,
    KINDS,
    LEVELS,
    MIXES,
    NARROW,
    SHARES,
    SIGNALS,
    WorldDraw,
    draw_world,
)
from benchmarks.world_files import cut_maps, make_files
from cavmarl.core.errors import ConfigError
from cavmarl.roads.cache import load_network

pytest.importorskip("sumo", reason="needs the extra 'sumo'")

SEEDS = range(300)
SECONDS = 200


def draw_all(without: tuple[str, ...] = ()) -> list[WorldDraw]:
    return [draw_world(seed, without) for seed in SEEDS]


def first_with(*features: str) -> WorldDraw:
    """Return the first world that has all features."""
    return next(draw for draw in draw_all() if set(features) <= set(draw.features))


def test_a_drawn_world_depends_only_on_its_seed_and_the_excluded_features() -> None:
    assert draw_world(7) == draw_world(7)
    assert draw_world(7, ("lefthand",)) == draw_world(7, ("lefthand",))
    assert len({draw_world(seed).net.options for seed in range(50)}) > 40


def test_every_feature_is_drawn_and_features_can_be_excluded() -> None:
    drawn = {name for draw in draw_all() for name in draw.features}
    assert drawn == FEATURES
    without = ("lefthand", "grid", "actuated", "all", "everywhere")
    assert not {name for draw in draw_all(without) for name in draw.features} & {*without}


@pytest.mark.parametrize("without", [("rightward",), tuple(KINDS), tuple(SIGNALS)])
def test_excluding_all_or_unknown_features_is_refused(without: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError, match="--without"):
        draw_all(without)


def test_a_world_has_one_of_each_kind_of_feature() -> None:
    for draw in draw_all():
        features = draw.features
        for names in (KINDS | NARROW, LEVELS, MIXES):
            assert len(set(features) & set(names)) == 1
        plain = bool({"cut", "zipper"} & {*features})
        assert len(set(features) & set(JUNCTIONS)) == (0 if plain else 1)
        assert not plain or not set(features) & set(SHARES)


def test_excluding_narrow_roads_does_not_change_other_worlds() -> None:
    narrow = [draw for draw in draw_all() if draw.net.kind in NARROW]
    assert 0.05 < len(narrow) / len(SEEDS) < 0.15
    others = {draw.seed: draw for draw in draw_all(tuple(NARROW))}
    for draw in draw_all():
        assert draw.net.kind in NARROW or draw == others[draw.seed]


def test_maps_have_the_drawn_zippers_and_pairs_of_signals(tmp_path: Path) -> None:
    net, _ = make_files(first_with("zipper"), tmp_path / "zipper", SECONDS, ())
    links = load_network(net).links
    zippers = links[links["state"] == ord("Z")]
    assert len(zippers) >= 4
    assert (zippers["num_conflicts"] == 1).all()
    net, _ = make_files(first_with("signal_pair"), tmp_path / "pair", SECONDS, ())
    edges = load_network(net).edges
    assert 5.0 < float(edges["length_m"][~edges["internal"]].min()) < 45.0


@pytest.mark.parametrize(
    "features",
    [("grid", "allway_stop"), ("spider", "traffic_light", "delay_based"), ("random", "all")],
)
def test_equal_draws_make_equal_traffic(tmp_path: Path, features: tuple[str, ...]) -> None:
    draw = first_with(*features)
    texts = []
    for name in ("one", "two"):
        net, routes = make_files(draw, tmp_path / name, SECONDS, ())
        texts.append((re.sub(r"<!--.*?-->", "", net.read_text(), flags=re.S), routes.read_text()))
    assert texts[0] == texts[1]
    nodes = {node.get("type") for node in ElementTree.parse(net).iter("junction")}
    signals = {logic.get("type") for logic in ElementTree.parse(net).iter("tlLogic")}
    for feature in features:
        if feature in JUNCTIONS:
            assert feature in nodes
        if feature in SIGNALS:
            assert signals == {feature}
    vehicles = list(ElementTree.parse(routes).iter("vehicle"))
    assert {one.get("type") for one in vehicles} <= set(draw.demand.shares)
    departs = [float(one.get("depart", "")) for one in vehicles]
    assert departs == sorted(departs)
    assert 0.0 <= departs[0] <= departs[-1] < SECONDS


def test_a_higher_level_of_traffic_has_more_vehicles_per_km(tmp_path: Path) -> None:
    counts = []
    for level in ("free", "near_capacity"):
        draw = first_with("grid", level, "everywhere")
        net, routes = make_files(draw, tmp_path / level, SECONDS, ())
        edges = load_network(net).edges
        lane_km = float((edges["length_m"] * edges["num_lanes"])[~edges["internal"]].sum()) / 1000.0
        counts.append(routes.read_text().count("<vehicle ") / lane_km)
    assert counts[1] > 1.5 * counts[0]


def test_a_cut_is_a_part_of_a_real_map(tmp_path: Path) -> None:
    draw = first_with("cut")
    net, routes = make_files(draw, tmp_path, SECONDS, cut_maps(None))
    west, south, east, north = load_network(net).extent_m
    # Edges that begin inside the cut may end outside, so the map may be larger than the cut.
    reach = 2.0 * draw.net.length_m + 600.0
    assert east - west < reach
    assert north - south < reach
    assert "<vehicle " in routes.read_text()


def test_a_folder_without_maps_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="has no map"):
        cut_maps(tmp_path)
