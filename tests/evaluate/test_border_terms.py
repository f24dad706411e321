"""Reward terms near borders and inside zones count each step of an agent once."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cavmarl.config.terms import TERMS
from cavmarl.evaluate import evaluate
from cavmarl.evaluate.border_terms import NEAR_M, BorderTerms, place_rows
from cavmarl.evaluate.evaluation import load_places, load_tables
from cavmarl.zones.partition.zone_partition import ZonePartition

HALVES = ZonePartition(
    (0.0, 0.0, 200.0, 100.0), np.array([[0.0, 0.0, 100.0, 100.0], [100.0, 0.0, 200.0, 100.0]])
)


def test_the_edge_of_the_map_is_not_a_border() -> None:
    record = BorderTerms(HALVES, step_s=0.5)
    places = np.array([[[1.0, 1.0], [100.0 - NEAR_M, 50.0], [99.0, 99.0], [100.0, 5.0]]])
    terms = np.zeros((1, 4, len(TERMS)), dtype=np.float32)
    terms[0, 2, TERMS.index("collision")] = 1.0
    terms[0, :, TERMS.index("jerk")] = [0.1, 0.3, 0.5, 0.25]
    record.add(places, np.array([[True, True, True, True]]), terms)
    record.add(places, np.array([[True, False, False, False]]), terms)
    np.testing.assert_array_equal(record.steps, [[3, 1], [0, 1]])
    rows = {(row["zone"], row["place"]): row for row in place_rows([record])}
    near = rows[0, "near border"]
    assert near["agent_hours"] == 0.5 / 3600.0
    assert near["collision_per_h"] == 7200.0
    np.testing.assert_allclose(rows[0, "inside"]["jerk"], 0.5 / 3.0)
    assert rows[1, "inside"]["jerk"] is None
    assert rows[-1, "inside"]["agent_hours"] == 1.5 / 3600.0
    np.testing.assert_allclose(rows[-1, "near border"]["jerk"], 0.375)


def test_an_evaluation_of_a_divided_world_counts_each_event_once(tmp_path: Path) -> None:
    divided = {"zones.count": 4}
    out = tmp_path / "out"
    evaluate("grid4x4", "never_yield", episodes=2, max_cycles=200, out=out, overrides=divided)
    rows = load_places(tmp_path / "out")["never_yield"]
    trips, _ = load_tables(tmp_path / "out")["never_yield"]
    every = [row for row in rows if row["zone"] == -1]
    collisions = sum((row["collision_per_h"] or 0.0) * row["agent_hours"] for row in every)
    np.testing.assert_allclose(collisions, trips["collision"].sum())
    hours = trips["duration_s"].sum() / 3600.0
    np.testing.assert_allclose(sum(row["agent_hours"] for row in every), hours)
    assert all(row["agent_hours"] > 0.0 for row in every)


def test_an_undivided_world_has_no_table_of_borders(tmp_path: Path) -> None:
    evaluate("ring", "idm", episodes=1, max_cycles=10, out=tmp_path / "out")
    assert load_places(tmp_path / "out") == {}
