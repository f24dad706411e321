"""Recorded traces: their files, late and lost poses, and playback by the code for clients."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cavmarl.core.errors import ActionError, CapacityError, ConfigError
from cavmarl.cosim.actors.pose_traces import PoseTrace, read_traces
from cavmarl.cosim.actors.pose_track import PoseSample
from cavmarl.cosim.followers.followed_world import FollowedWorld
from tests.cosim.test_client_actors import STEP_S, far_place, make_env, others

HEAD = "time_s,x,y,heading"


def write_trace(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "van.csv"
    path.write_text(text, encoding="utf-8")
    return path


def straight(x: float, y: float, count: int = 40, every_s: float = 0.02) -> PoseTrace:
    """Return a trace along the x axis at 10 m/s, at 50 Hz, with poses that arrive without delay."""
    stamps = [round(k * every_s, 6) for k in range(count)]
    samples = [PoseSample(stamp, x + 10.0 * stamp, y, 0.0) for stamp in stamps]
    return PoseTrace("van", "car", None, samples, stamps)


def test_a_file_has_one_trace_per_id_with_types_and_sizes(tmp_path: Path) -> None:
    path = write_trace(
        tmp_path,
        "id,type,time_s,x,y,heading,speed,received_s,length,width,height\n"
        "a,truck,10.0,1,2,0.5,3,10.1,6,2,3\n"
        "b,cyclist,10.1,5,6,0.0,,,,,\n"
        "a,truck,10.2,2,2,0.5,3,10.4,6,2,3\n",
    )
    a, b = read_traces(path)
    assert (a.name, a.vtype, a.size_m) == ("a", "truck", (6.0, 2.0, 3.0))
    assert a.samples[1] == PoseSample(pytest.approx(0.2), 2.0, 2.0, 0.5, speed=3.0)
    assert a.received_s == pytest.approx([0.1, 0.4])
    assert a.rate_hz == pytest.approx(5.0)
    assert (b.name, b.vtype, b.size_m, b.rate_hz) == ("b", "cyclist", None, 0.0)
    assert b.samples[0].stamp_s == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("time_s,x,y\n0,1,2\n", "no column heading"),
        (f"{HEAD}\n", "has no rows"),
        (f"{HEAD}\n0,1,nan,2\n", "y = nan: must be a finite number"),
        (f"{HEAD}\n0,1,two,2\n", "y = two: must be a finite number"),
        (f"{HEAD}\n0,1,,2\n", "a row has no y"),
        (f"{HEAD},received_s\n5,1,2,0,4\n", "received_s before time_s"),
        (f"{HEAD},vclass\n0,1,2,0,truck\n", "vclass = truck: must be from 0 to 9"),
        (f"{HEAD},vclass\n0,1,2,0,99\n", "vclass = 99: must be from 0 to 9"),
        (f"{HEAD},length,width\n0,1,2,0,4,2\n", "has no height; give length, width and"),
    ],
)
def test_invalid_files_are_refused(tmp_path: Path, text: str, match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        read_traces(write_trace(tmp_path, text))


def test_a_byte_order_mark_is_not_part_of_a_column_name(tmp_path: Path) -> None:
    (trace,) = read_traces(write_trace(tmp_path, f"\ufeff{HEAD}\n0,1,2,0\n"))
    assert trace.samples[0].x == 1.0


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        read_traces(tmp_path / "none.csv")


def play(address: Path, traces: list[PoseTrace], steps: int, **more: Any) -> tuple[Any, ...]:
    """Play traces; return places of actors per step, the report, refusals and other vehicles."""
    places = []
    with closing(make_env(**more)) as env, FollowedWorld(env, address, traces=traces) as world:
        world.reset(seed=1)
        for _ in range(steps):
            world.step()
            places.append([(float(row["x"]), float(row["y"])) for row in env.external.vehicles()])
        return places, world.actors.report(), world.player.refused, others(env)


def test_a_body_follows_its_trace_and_leaves_after_it(address: Path) -> None:
    with closing(make_env()) as env:
        x, y = far_place(env)
    places, (report,), refused, rows = play(address, [straight(x, y)], 25)
    for step in range(15):
        ((found, _),) = places[step]
        # The last pose before the end of a step is up to 20 ms old, so the body is extrapolated.
        assert found == pytest.approx(
            x + 10.0 * (step + 1) * STEP_S, abs=0.21 if step < 1 else 1e-6
        )
    assert places[-1] == []
    assert (report["received"], report["late"], report["lost"]) == (40, 0, 0)
    assert report["extrapolated"] > 0
    assert refused == 0
    _, _, _, without = play(address, [], 25)
    assert rows == without  # no other vehicle sees the body


def test_late_and_lost_poses_of_a_trace_are_counted(address: Path) -> None:
    with closing(make_env()) as env:
        x, y = far_place(env)
    whole = straight(x, y, count=50)
    kept = [k for k in range(50) if k not in (20, 21, 22)]
    arrivals = {k: whole.received_s[k] + (0.3 if k == 30 else 0.0) for k in kept}
    order = sorted(kept, key=lambda k: (arrivals[k], k))
    trace = PoseTrace(
        "van", "car", None, [whole.samples[k] for k in order], [arrivals[k] for k in order]
    )
    _, (report,), _, _ = play(address, [trace], 25)
    assert (report["late"], report["lost"]) == (1, 3)  # pose 30 is late but not lost


def test_a_body_waits_for_a_free_place(address: Path) -> None:
    with closing(make_env()) as env:
        env.reset(seed=1)
        row = env.simulation.vehicles()[0]
        x, y = float(row["x"]), float(row["y"])
    samples = [PoseSample(k * STEP_S, x, y, 0.0) for k in range(200)]
    trace = PoseTrace("van", "pedestrian", None, samples, [pose.stamp_s for pose in samples])
    places, _, refused, _ = play(address, [trace], 60)
    assert places[0] == []
    assert 0 < refused < 60
    assert places[refused] == [(x, y)]


def test_a_world_that_refuses_a_trace_says_why(address: Path) -> None:
    with closing(make_env()) as env:
        x, y = far_place(env)
    several = [replace(straight(x, y + 10.0 * k), name=f"van {k}") for k in range(4)]
    with pytest.raises(CapacityError, match=r"population\.external are in use"):
        play(address, several, 1)
    with pytest.raises(ActionError, match="outside of the map"):
        play(address, [straight(1e6, y)], 1)
    with pytest.raises(ActionError, match="vtype = 'tank'"):
        play(address, [replace(straight(x, y), vtype="tank")], 1)


def test_a_trace_starts_again_in_each_episode(address: Path) -> None:
    with closing(make_env()) as env:
        x, y = far_place(env)
        with FollowedWorld(env, address, traces=[straight(x, y)]) as world:
            runs = []
            for _ in range(2):
                world.reset(seed=1)
                places = []
                for _ in range(8):
                    world.step()
                    places.append(float(env.external.vehicles()["x"][0]))
                runs.append(places)
            assert runs[0] == runs[1]
