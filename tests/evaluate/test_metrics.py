"""Metrics of trips whose values are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.evaluate.metrics import METRICS, metric_values
from cavmarl.evaluate.tables import EPISODE, TRIP, read_table, write_table

BY_NAME = {metric.name: metric for metric in METRICS}


def trips(*distances_m: float) -> NDArray[np.void]:
    """Return trips that count for metrics, without infractions."""
    rows = np.zeros(len(distances_m), TRIP)
    rows["distance_m"], rows["counted"] = distances_m, True
    return rows


def values(name: str, rows: NDArray[np.void]) -> list[float]:
    return metric_values(BY_NAME[name], rows, np.zeros(0, EPISODE)).tolist()


@pytest.mark.parametrize("infraction", ["collision", "off_road", "red_light", "wrong_way"])
def test_kilometres_per_infraction_count_each_infraction(infraction: str) -> None:
    rows = trips(4000.0, 1500.0, 500.0)
    assert values("km_per_infraction", rows) == [6.0], (
        "without an infraction, the value is not the whole distance"
    )
    rows[infraction][0] = True
    rows["red_light"][1] = True
    assert values("km_per_infraction", rows) == [3.0]
    rows["collision"][2] = True
    assert values("km_per_infraction", rows) == [2.0]


def test_negative_distances_do_not_count() -> None:
    assert values("km_per_infraction", trips(3000.0, -1000.0)) == [3.0]
    assert values("km_per_infraction", trips()) == []


def test_energy_and_co2_are_divided_by_the_kilometres_of_all_trips() -> None:
    rows = trips(3000.0, -1000.0, 1000.0)
    rows["energy_wh"], rows["co2_g"] = (500.0, 50.0, -30.0), (400.0, 100.0, 100.0)
    assert values("energy_wh_per_km", rows) == [130.0]
    assert values("co2_g_per_km", rows) == [150.0]
    assert values("co2_g_per_km", trips()) == values("co2_g_per_km", trips(-5.0)) == []


def test_energy_from_an_older_file_is_nan(tmp_path: Path) -> None:
    rows = trips(3000.0)
    write_table(tmp_path / "new.csv", {"idm": rows}, TRIP)
    assert read_table(tmp_path / "new.csv", TRIP)["idm"].tobytes() == rows.tobytes()
    older = np.dtype([(name, TRIP[name]) for name in TRIP.names or () if name != "energy_wh"])
    write_table(tmp_path / "old.csv", {"idm": rows[list(older.names or ())]}, older)
    found = read_table(tmp_path / "old.csv", TRIP)["idm"]
    assert np.isnan(found["energy_wh"]).all()
    assert found["distance_m"].tolist() == [3000.0]
    assert all(np.isnan(values("energy_wh_per_km", found)))
    assert values("co2_g_per_km", found) == [0.0]


def test_a_table_with_an_incomplete_line_is_refused(tmp_path: Path) -> None:
    write_table(tmp_path / "cut.csv", {"idm": trips(3000.0, 2000.0)}, TRIP)
    text = (tmp_path / "cut.csv").read_text(encoding="utf-8")
    (tmp_path / "cut.csv").write_text(text.rstrip().rpartition(",")[0], encoding="utf-8")
    with pytest.raises(ValueError, match="shorter"):
        read_table(tmp_path / "cut.csv", TRIP)


def test_trips_that_do_not_count_have_no_values() -> None:
    rows = trips(1000.0, 2000.0)
    rows["counted"][1] = False
    rows["collision"][1] = True
    assert values("km_per_infraction", rows) == [1.0]
    assert values("collision", rows) == [0.0]


def test_only_trips_that_arrived_have_a_delay() -> None:
    rows = trips(1000.0, 2000.0, 3000.0)
    rows["delay_s"], rows["arrived"] = (5.0, 90.0, 7.0), (True, False, True)
    assert values("delay_s", rows) == [5.0, 7.0]
    assert values("mean_speed_mps", rows) == [0.0, 0.0, 0.0]
