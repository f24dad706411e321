from __future__ import annotations

import itertools
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cavmarl.config.registry import load_config, resolve_map
from cavmarl.driving.kernels.models.krauss import dawdle, safe_speed
from tests.naive import krauss as naive

GAPS = st.floats(-10.0, 300.0) | st.sampled_from([0.0, 1.0])
SPEEDS = st.floats(0.0, 45.0) | st.just(0.0)
DECELS = st.floats(0.5, 9.0)
TIMES = st.floats(0.05, 3.0)


@given(GAPS, SPEEDS, DECELS, DECELS, TIMES)
def test_the_safe_speed_equals_twin(
    gap: float, front_speed: float, decel: float, front_decel: float, reaction_s: float
) -> None:
    state = (gap, front_speed, decel, front_decel, reaction_s)
    assert safe_speed(*state) == pytest.approx(naive.safe_speed(*state), abs=1e-9)


@given(SPEEDS, DECELS, st.floats(0.0, 1.0), st.floats(0.0, 1.0, exclude_max=True), TIMES)
def test_imperfection_equals_twin(
    speed: float, accel: float, sigma: float, share: float, dt: float
) -> None:
    left = dawdle(speed, accel, sigma, share, dt)
    assert left == pytest.approx(naive.dawdle(speed, accel, sigma, share, dt), abs=1e-12)
    assert 0.0 <= left <= speed


@pytest.mark.parametrize(
    ("speed", "left"),
    # The loss is 0.5 · 0.5 · 2.6 m/s² · 0.1 s; below 2.6 m/s it is proportional to the speed.
    [(10.0, 9.935), (2.6, 2.535), (1.0, 0.975), (0.0, 0.0)],
)
def test_imperfection_is_smaller_at_low_speed(speed: float, left: float) -> None:
    assert dawdle(speed, 2.6, 0.5, 0.5, 0.1) == pytest.approx(left)


@given(st.floats(0.0, 100.0), SPEEDS, DECELS, DECELS, TIMES)
def test_a_follower_at_the_safe_speed_never_touches_its_leader(
    gap: float, front_speed: float, decel: float, front_decel: float, reaction_s: float
) -> None:
    speed = safe_speed(gap, front_speed, decel, front_decel, reaction_s)
    hardest = max(decel, front_decel)
    stop_s = reaction_s + speed / decel + front_speed / hardest
    for share in range(21):
        time = 0.05 * share * stop_s
        braked = min(max(time - reaction_s, 0.0), speed / decel)
        mine = speed * min(time, reaction_s) + speed * braked - 0.5 * decel * braked**2
        front = min(time, front_speed / hardest)
        other = front_speed * front - 0.5 * hardest * front**2
        # A driver that brakes harder than its leader may be closer during braking than at the end,
        # so check such a driver only at the end.
        if decel <= front_decel or time >= stop_s:
            assert mine <= gap + other + 1e-6


DT, ACCEL, TAU = 0.1, 2.6, 1.0
CASES = [
    {"gap": gap, "front": front, "decel": decel, "front_decel": front_decel}
    for gap, front, decel, front_decel in itertools.product(
        (0.0, 2.0, 11.3, 60.0), (0.0, 3.3, 14.0, 30.0), (3.0, 4.5), (3.0, 4.5, 7.0)
    )
]

# This program runs in a child process, because a process can load libsumo only once.
ASK = """
import json, sys
import libsumo
asked = json.load(sys.stdin)
libsumo.start(["sumo", "-n", sys.argv[1], "--step-length", sys.argv[2], "--no-step-log"])
libsumo.route.add("r", [sys.argv[3]])
answers = []
for n, case in enumerate(asked):
    name = f"t{n}"
    libsumo.vehicletype.copy("DEFAULT_VEHTYPE", name)
    libsumo.vehicletype.setDecel(name, case["decel"])
    libsumo.vehicletype.setTau(name, case["tau"])
    libsumo.vehicle.add(name, "r", typeID=name)
    ask = libsumo.vehicle
    answers.append({
        "follow": ask.getFollowSpeed(name, case["own"], case["gap"], case["front"],
                                     case["front_decel"]),
        "stop": ask.getStopSpeed(name, case["own_stop"], case["gap"]),
        "secure": ask.getSecureGap(name, case["own"], case["front"], case["front_decel"]),
    })
print(json.dumps(answers))
"""


def ours(case: dict[str, float]) -> tuple[float, float]:
    """Return the safe speeds behind the leader and before a line, for SUMO's discrete motion.

    SUMO drives a whole step at the new speed. A braking vehicle therefore drives half a step less
    far than in continuous time. So subtract half a step from the reaction time, and the distance
    that the leader drives in half a step from the gap.
    """
    gap = case["gap"] - 0.5 * DT * case["front"]
    follow = safe_speed(gap, case["front"], case["decel"], case["front_decel"], TAU - 0.5 * DT)
    # Before a line, SUMO's drivers react within one step.
    stop = safe_speed(case["gap"], 0.0, case["decel"], case["decel"], DT - 0.5 * DT)
    return follow, stop


@pytest.fixture(scope="module")
def answers() -> list[tuple[dict[str, float], dict[str, float]]]:
    """Return the cases and SUMO's results.

    The speed of the follower in each case is the safe speed, so that SUMO applies no other limit.
    """
    pytest.importorskip("libsumo", reason="needs the extra 'sumo'")
    pytest.importorskip("sumo", reason="needs the extra 'sumo'")
    cases = []
    for case in CASES:
        follow, stop = ours(case)
        cases.append(case | {"tau": TAU, "own": follow, "own_stop": stop})
    map_file: Path = resolve_map(*load_config("merge"))
    asked = subprocess.run(
        [sys.executable, "-c", ASK, str(map_file), str(DT), "main_in"],
        input=json.dumps(cases), capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    lines: list[Any] = json.loads(asked.stdout.strip().splitlines()[-1])
    assert len(lines) == len(cases)
    return list(zip(cases, lines, strict=True))


def test_the_safe_speed_equals_sumos_safe_speed(
    answers: list[tuple[dict[str, float], dict[str, float]]],
) -> None:
    for case, theirs in answers:
        # SUMO interpolates braking distances linearly between whole numbers of steps. The error is
        # at most decel · dt² / 8 in metres of gap per car. Divided by the slope of the braking
        # distance, this is an error of speed. SUMO also subtracts 1 mm from every gap.
        decel = case["decel"]
        error = decel * DT * DT / 8.0 + 1e-3
        follow, stop = ours(case)
        steep = TAU - 0.5 * DT + max(follow / decel - DT, 0.0)
        assert theirs["follow"] == pytest.approx(follow, abs=2.0 * error / steep), case
        steep = 0.5 * DT + max(stop / decel - DT, 0.0)
        assert theirs["stop"] == pytest.approx(stop, abs=error / steep), case


def test_the_safe_gap_equals_sumos_safe_gap(
    answers: list[tuple[dict[str, float], dict[str, float]]],
) -> None:
    for case, theirs in answers:
        # This error is that of both cars' interpolations, in metres. SUMO returns no negative gap.
        hardest = max(case["decel"], case["front_decel"])
        error = (case["decel"] + hardest) * DT * DT / 8.0
        if theirs["secure"] > 0.0:
            assert theirs["secure"] == pytest.approx(case["gap"], abs=error), case
