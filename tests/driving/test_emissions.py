"""Energy, CO₂ and fuel of vehicles, compared with SUMO's on the same driving cycles."""

from __future__ import annotations

import csv
import os
import subprocess
from pathlib import Path

import defusedxml.ElementTree
import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.records.codes import CLASS_PEDESTRIAN
from cavmarl.driving.kernels.emissions import FUEL_PER_CO2
from cavmarl.driving.vehicle_emissions import emissions_of
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.roads.network import VEHICLE_CLASSES

SUMO_CLASSES = {
    "passenger": "HBEFA4/PC_petrol_Euro-4",
    "truck": "HBEFA4/RT_le7.5t_Euro-VI_A-C",
    "bus": "HBEFA4/UBus_Std_gt15-18t_Euro-VI_A-C",
    "motorcycle": "HBEFA4/MC_4S_gt250cc_preEuro",
    "emergency": "HBEFA4/LCV_diesel_N1-III_Euro-6ab",
    "delivery": "HBEFA4/LCV_diesel_N1-III_Euro-6ab",
    "taxi": "HBEFA4/PC_petrol_Euro-4",
}
CO2, FUEL, ELECTRICITY = 5, 9, 10  # columns of emissionsDrivingCycle
COUNT = 1500


def sumo_run(program: str, *arguments: str | Path) -> None:
    home = pytest.importorskip("sumo", reason="needs the package eclipse-sumo").SUMO_HOME
    subprocess.run(
        [Path(home, "bin", program), *arguments],
        check=True,
        env={**os.environ, "SUMO_HOME": home},
        stdout=subprocess.DEVNULL,
    )


def driving_cycle(folder: Path, emission_class: str, rows: NDArray[np.void]) -> NDArray[np.float64]:
    """Return SUMO's table (n, 11) for these rows: emissions in mg/s, electricity in Wh."""
    cycle, found = folder / "cycle.csv", folder / "found.csv"
    slopes = np.degrees(rows["pitch"])
    columns = zip(rows["speed"].tolist(), rows["accel"].tolist(), slopes.tolist(), strict=True)
    cycle.write_text("\n".join(f"{k};{v!r};{a!r};{s!r}" for k, (v, a, s) in enumerate(columns)))
    sumo_run(
        "emissionsDrivingCycle", "--have-slope", "-t", cycle, "-o", found, "-e", emission_class
    )
    with found.open() as file:
        return np.array(
            [[float(cell) for cell in line] for line in csv.reader(file, delimiter=";")]
        )


def cycle_rows(seed: int) -> NDArray[np.void]:
    """Return VEHICLE (n,), a row per second, with random accelerations and slopes."""
    numbers = np.random.default_rng(seed)
    rows = np.zeros(COUNT, VEHICLE)
    speed = 0.0
    for row in rows:
        before, speed = speed, max(0.0, speed + float(numbers.uniform(-3.0, 3.0)))
        speed = min(speed, 40.0)
        row["speed"], row["accel"] = speed, speed - before
    rows["pitch"] = np.radians(numbers.uniform(-4.0, 4.0, COUNT))
    rows["pitch"][::3] = 0.0
    return rows


def our(rows: NDArray[np.void], name: str = "passenger", dt_s: float = 1.0) -> NDArray[np.float64]:
    return emissions_of(rows, np.full(len(rows), VEHICLE_CLASSES.index(name)), dt_s)


@pytest.mark.parametrize("name", SUMO_CLASSES)
def test_co2_and_fuel_of_each_class_equal_those_of_sumo(name: str, tmp_path: Path) -> None:
    rows = cycle_rows(1)
    expected = driving_cycle(tmp_path, SUMO_CLASSES[name], rows)
    co2_mg = 1e3 * our(rows, name)[:, 1]
    # SUMO prints six digits. Rounding may decide whether a vehicle counts as coasting, so a few
    # rows may differ.
    near = np.abs(co2_mg - expected[:, CO2]) > 1e-5 * expected[:, CO2] + 0.01
    assert np.count_nonzero(near) <= 3
    assert np.count_nonzero(co2_mg[~near]) > COUNT // 3
    fuel_mg = co2_mg * FUEL_PER_CO2[VEHICLE_CLASSES.index(name)]
    assert fuel_mg[~near].sum() == pytest.approx(expected[~near, FUEL].sum(), rel=3e-4)
    np.testing.assert_allclose(fuel_mg[~near], expected[~near, FUEL], rtol=3e-4, atol=3.0)


def test_energy_equals_the_energy_of_sumos_electric_car(tmp_path: Path) -> None:
    rows = cycle_rows(2)
    expected = driving_cycle(tmp_path, "Energy/unknown", rows)[:, ELECTRICITY]
    energy_wh = our(rows)[:, 0]
    np.testing.assert_allclose(energy_wh, expected, rtol=1e-5, atol=1e-5)
    assert expected.min() < -1.0 < 1.0 < expected.max()


def test_energy_of_a_drive_equals_sumos_except_for_friction_in_curves(tmp_path: Path) -> None:
    """SUMO adds friction in curves, which is 3.5 % of the energy of this drive."""
    edges = "left0A0 A0B0 B0B1 B1C1 C1C0 C0D0 D0D1 D1C1"
    (tmp_path / "rou.xml").write_text(
        '<routes><vType id="electric" emissionClass="Energy/unknown"/>'
        '<vType id="petrol" emissionClass="HBEFA4/PC_petrol_Euro-4"/>'
        f'<vehicle id="0" type="electric" depart="0"><route edges="{edges}"/></vehicle>'
        f'<vehicle id="1" type="petrol" depart="5"><route edges="{edges}"/></vehicle></routes>'
    )
    sumo_run(
        "sumo", "-n", "envs/grid4x4/map/map.net.xml", "-r", tmp_path / "rou.xml", "--no-step-log",
        "--device.emissions.probability=1", "--emission-output", tmp_path / "emissions.xml",
        "--fcd-output", tmp_path / "fcd.xml", "--fcd-output.acceleration", "--precision=6",
    )  # fmt: skip

    def column(file: str, vehicle: int, name: str) -> NDArray[np.float64]:
        root = defusedxml.ElementTree.parse(tmp_path / file).getroot()
        found = [one.get(name) for one in root.iter("vehicle") if one.get("id") == str(vehicle)]
        return np.array(found, np.float64)

    totals = []
    for vehicle in (0, 1):
        rows = np.zeros(len(column("fcd.xml", vehicle, "speed")), VEHICLE)
        rows["speed"] = column("fcd.xml", vehicle, "speed")
        rows["accel"] = column("fcd.xml", vehicle, "acceleration")
        totals.append(our(rows)[:, vehicle].sum())
        assert rows["speed"].sum() > 800.0
    energy_wh, co2_g = totals
    assert co2_g == pytest.approx(1e-3 * column("emissions.xml", 1, "CO2").sum(), rel=1e-5)
    turned = np.abs((np.diff(column("fcd.xml", 0, "angle"), prepend=0.0) + 180.0) % 360.0 - 180.0)
    turned[0] = 0.0
    curves_wh = (0.1 * 1830.0 * column("fcd.xml", 0, "speed") * np.radians(turned)).sum() / 3600.0
    sumos_wh = column("emissions.xml", 0, "electricity").sum()
    assert 1.03 < sumos_wh / energy_wh < 1.04
    assert energy_wh + curves_wh == pytest.approx(sumos_wh, rel=1e-3)


def test_trams_bicycles_and_pedestrians_have_no_engine() -> None:
    rows = cycle_rows(3)
    for vclass in (*map(VEHICLE_CLASSES.index, ("tram", "bicycle")), CLASS_PEDESTRIAN):
        assert not emissions_of(rows, np.full(COUNT, vclass), 1.0).any()
        assert FUEL_PER_CO2[vclass] == 0.0
    assert len(FUEL_PER_CO2) == CLASS_PEDESTRIAN + 1


def test_driving_backwards_takes_the_same_energy_as_forwards() -> None:
    rows = cycle_rows(4)
    rows = rows[rows["speed"] > 0.0]  # a vehicle that stands has no direction
    back = rows.copy()
    for name in ("speed", "accel", "pitch"):
        back[name] = -rows[name]
    np.testing.assert_array_equal(our(back), our(rows))


def test_energy_of_a_drive_does_not_depend_on_the_length_of_a_step() -> None:
    """At constant acceleration, ten steps of 0.1 s and one of 1 s differ only by the air drag."""
    short = np.zeros(10, VEHICLE)
    short["speed"], short["accel"] = 10.0 + 0.2 * np.arange(1, 11), 2.0
    long = short[-1:]
    assert our(short, dt_s=0.1)[:, 0].sum() == pytest.approx(our(long, dt_s=1.0)[0, 0], rel=0.02)
