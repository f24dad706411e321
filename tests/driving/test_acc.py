"""Adaptive cruise control of five followers behind one leader, compared with SUMO's."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.core.records.codes import MODEL_ACC
from cavmarl.driving.kernels.models.acc import acc_acceleration
from cavmarl.driving.kernels.models.following import behind, no_constraint, response
from cavmarl.driving.vehicle_types import CLASS_DEFAULTS, VTYPE, set_model

DT, STEPS, FOLLOWERS = 0.1, 1000, 5
START_MPS, START_GAP_M, LIMIT_MPS = 20.0, 22.5, 30.0
SPEED_MPS, GAP_M = 0.2, 0.3  # largest accepted differences from SUMO, of any vehicle in any step
MEAN_SPEED_MPS, MEAN_GAP_M = 0.02, 0.05  # largest accepted mean differences

# This program runs in a child process, because a process can load libsumo only once.
RUN = """
import json, sys
import libsumo
net, profile = sys.argv[1], json.load(sys.stdin)
libsumo.start(["sumo", "-n", net, "--step-length", sys.argv[2], "--no-step-log",
               "--collision.action", "none"])
libsumo.route.add("r", ["road"])
libsumo.vehicletype.copy("DEFAULT_VEHTYPE", "lead")
count, start, gap = int(sys.argv[3]), float(sys.argv[4]), float(sys.argv[5])
place = 400.0
for k in range(count + 1):
    libsumo.vehicle.add(f"v{k}", "r", typeID="lead" if k == 0 else "acc",
                        departPos=str(place - k * (gap + 5.0)), departSpeed=str(start))
    libsumo.vehicle.setSpeedFactor(f"v{k}", 1.0)
libsumo.vehicle.setSpeedMode("v0", 0)
libsumo.vehicle.setSpeed("v0", profile[0])
libsumo.simulationStep()
rows = []
for speed in profile:
    libsumo.vehicle.setSpeed("v0", speed)
    libsumo.simulationStep()
    rows.append([(libsumo.vehicle.getLanePosition(f"v{k}"), libsumo.vehicle.getSpeed(f"v{k}"))
                 for k in range(count + 1)])
print(json.dumps(rows))
"""

TYPES = """<additional><vType id="acc" carFollowModel="ACC" tau="1.0" sigma="0" speedDev="0"/>
</additional>"""


def profile() -> list[float]:
    """Return the leader's speeds: constant, down to 8 m/s, constant, up to 24 m/s, then a wave."""
    speeds = []
    speed = START_MPS
    for step in range(STEPS):
        time = step * DT
        if 10.0 <= time < 18.0:
            speed -= 1.5 * DT
        elif 35.0 <= time < 51.0:
            speed += 1.0 * DT
        elif time >= 70.0:
            speed = 24.0 + 2.0 * math.sin(0.3 * (time - 70.0))
        speeds.append(speed)
    return speeds


def car() -> np.void:
    """Return SUMO's passenger car with adaptive cruise control."""
    kind = np.zeros(1, VTYPE)[0]
    for field, value in CLASS_DEFAULTS["passenger"]._asdict().items():
        if field in (VTYPE.names or ()):
            kind[field] = value
    set_model(kind, MODEL_ACC)
    kind["tau"], kind["sigma"] = 1.0, 0.0
    return kind


def driven(places: np.ndarray, speeds: np.ndarray) -> np.ndarray:
    """Drive from the given initial state; return positions and speeds (steps, vehicles, 2)."""
    kind, rows = car(), []
    places, speeds = places.copy(), speeds.copy()
    for lead in profile()[1:]:
        accels = []
        for k in range(1, FOLLOWERS + 1):
            gap = places[k - 1] - 5.0 - places[k]
            constraint = max(
                no_constraint(kind), behind(kind, speeds[k], gap, speeds[k - 1], kind["decel"])
            )
            accels.append(response(kind, speeds[k], LIMIT_MPS, constraint, 0.0, DT))
        speeds[1:] = np.maximum(speeds[1:] + DT * np.array(accels), 0.0)
        speeds[0] = lead
        places = places + DT * speeds
        rows.append(np.stack([places, speeds], axis=1))
    return np.array(rows)


@pytest.fixture(scope="module")
def theirs(tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    """Return the positions and speeds (steps, vehicles, 2) that SUMO computes."""
    sumo: Any = pytest.importorskip("sumo", reason="needs the extra 'sumo'")
    pytest.importorskip("libsumo", reason="needs the extra 'sumo'")
    folder = tmp_path_factory.mktemp("acc")
    (folder / "n.xml").write_text(
        '<nodes><node id="a" x="0" y="0"/><node id="b" x="6000" y="0"/></nodes>'
    )
    (folder / "e.xml").write_text(
        f'<edges><edge id="road" from="a" to="b" numLanes="1" speed="{LIMIT_MPS}"/></edges>'
    )
    (folder / "types.add.xml").write_text(TYPES)
    netconvert = Path(sumo.SUMO_HOME) / "bin" / "netconvert"
    net = folder / "net.xml"
    words = ["-n", folder / "n.xml", "-e", folder / "e.xml", "-o", net]
    subprocess.run([netconvert, *words], check=True, capture_output=True, timeout=120)
    run = RUN.replace('"--no-step-log",', f'"--no-step-log", "-a", "{folder / "types.add.xml"}",')
    words = [str(net), str(DT), str(FOLLOWERS), str(START_MPS), str(START_GAP_M)]
    said = subprocess.run(
        [sys.executable, "-c", run, *words],
        input=json.dumps(profile()), capture_output=True, text=True, check=True, timeout=300,
    )  # fmt: skip
    return np.array(json.loads(said.stdout.strip().splitlines()[-1]))


def test_a_platoon_with_acc_drives_as_in_sumo(theirs: np.ndarray) -> None:
    """Compare speeds and gaps of five followers over 100 s, by largest and mean differences."""
    first, rest = theirs[0], theirs[1:]
    ours = driven(first[:, 0], first[:, 1])
    speed_off = np.abs(ours[:, 1:, 1] - rest[:, 1:, 1])
    gap_off = np.abs(np.diff(ours[:, :, 0], axis=1) - np.diff(rest[:, :, 0], axis=1))
    assert speed_off.max() < SPEED_MPS
    assert gap_off.max() < GAP_M
    assert speed_off.mean() < MEAN_SPEED_MPS
    assert gap_off.mean() < MEAN_GAP_M
    assert (np.diff(ours[:, :, 0], axis=1) < -5.0).all(), "a car touches its leader"


@pytest.mark.parametrize(
    ("room", "front_mps", "expected"),
    [
        (math.inf, 0.0, 0.4 * 5.0),  # free road: accelerate to the allowed speed
        (60.0, 20.0, 0.4 * 5.0),  # the leader is over 2 s away and ignored
        (20.1, 20.05, 0.23 * 0.1 + 0.07 * 0.05),  # close to the desired gap
        (25.0, 21.0, 0.04 * 5.0 + 0.8 * 1.0),  # the gap is too large
        (17.0, 19.0, -0.8 * 3.0 - 0.23 * 1.0),  # the gap is too small
    ],
)
def test_acc_has_the_acceleration_of_each_of_its_four_modes(
    room: float, front_mps: float, expected: float
) -> None:
    asked = acc_acceleration(20.0, 25.0, room, front_mps, 4.5, 1.0, 2.6, 4.5)
    assert asked == pytest.approx(expected, abs=1e-9)
