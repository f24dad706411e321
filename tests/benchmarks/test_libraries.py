"""The cost of adapters: the benchmark measures each installed library on the same world."""

from __future__ import annotations

from benchmarks import libraries
from benchmarks.libraries import measure


def test_every_adapter_is_measured_or_its_missing_extra_is_named() -> None:
    found = measure("merge", agents=3, steps=2, at_most=1e-9)
    assert [row["view"] for row in found.rows] == list(libraries.VIEWS)
    for row in found.rows:
        if row["step_ms"] is None:
            assert "pip install" in row["missing"]
        else:
            assert row["step_ms"] > 0.0
    assert found.to_dict()["agents"] == 3
    assert not found.holds


def test_all_adapters_step_the_same_world() -> None:
    """All adapters get equal seeds and actions, so their rewards must be equal."""
    settings = {
        "agents": 3,
        "background": 0,
        "overrides": {"population.mode": "respawn", "action.kind": "continuous"},
    }
    arrays = libraries.VIEWS["arrays"]("merge", settings)
    dicts = libraries.VIEWS["dicts"]("merge", settings)
    rows = libraries.VIEWS["gymnasium"]("merge", settings)
    for _ in range(20):
        wanted = arrays()[1].ravel().tolist()  # type: ignore[index]
        assert list(dicts()[1].values()) == wanted  # type: ignore[index]
        assert rows()[1].tolist() == wanted  # type: ignore[index]
