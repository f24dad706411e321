"""Worlds of logged scenes: replayed road users, agents in logged vehicles, reactive drivers.

A divided world equals the undivided one, bit for bit, over zones, workers and nodes.
"""

from __future__ import annotations

import logging
import os
import signal
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl import (
    CavEnv,
    ConfigError,
    MapError,
    ScenarioError,
    UnknownEnvironmentError,
    make_vec,
    parallel_env,
)
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.records.codes import DRIVER_AGENT, DRIVER_BACKGROUND, DRIVER_EXTERNAL
from cavmarl.engine.world_setup import load_world
from cavmarl.env.recorded_inputs import INPUTS
from cavmarl.recordings.extra_tables import RecordOptions
from cavmarl.recordings.recording import Recording
from cavmarl.traffic.scenarios.lane_matching import LaneMatcher
from cavmarl.traffic.scenarios.library import plan_scene
from cavmarl.verify.recorded_runs import repeat_recording
from tests.support.logged_scenes import (
    ASIDE_M,
    TIMES,
    lane_lines,
    scenario,
    track,
    write_json_scene,
    write_pickle,
)

REACTIVE: dict[str, Any] = {"scenario.params": {"reactive": True}}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pickle(tmp_path_factory.mktemp("scene"))


def made(scene: Path, **more: Any) -> CavEnv:
    env = parallel_env(scene, **more)
    env.reset(seed=0)
    return env


def advance(env: CavEnv, steps: int) -> None:
    for _ in range(steps):
        env.step(env.suggest_actions())


def rows_of(env: CavEnv, driver: int) -> NDArray[np.void]:
    rows = env.simulation.vehicles(0)
    rows = rows[rows["driver"] == driver]
    found: NDArray[np.void] = rows[np.argsort(rows["id"])]
    return found


def test_without_settings_the_agent_drives_the_vehicle_that_logged_the_scene(scene: Path) -> None:
    with closing(made(scene)) as env:
        assert env.config.max_steps == TIMES - 1
        (agent,) = rows_of(env, DRIVER_AGENT)
        assert (agent["x"], agent["y"]) == pytest.approx((-60.0, -ASIDE_M), abs=1e-5)
        assert agent["speed"] == pytest.approx(10.0, abs=1e-4)
        assert (agent["length"], agent["width"]) == (4.5, 2.0)
        assert len(rows_of(env, DRIVER_EXTERNAL)) == 4  # the fifth road user appears later
        goal = env.simulation.goal_edges[0, agent["goal"]]
        line = env.network.lane_polyline(int(env.network.edges["first_lane"][goal]))
        assert line[-1, 0] == pytest.approx(100.0)


def test_replayed_road_users_are_at_their_logged_places(scene: Path) -> None:
    tracks = {name: entry["state"] for name, entry in scenario()["tracks"].items() if name != "7"}
    with closing(made(scene)) as env:
        for step in range(TIMES - 1):
            rows = rows_of(env, DRIVER_EXTERNAL)
            found = sorted(map(tuple, np.stack([rows["x"], rows["y"]], axis=1).tolist()))
            logged = sorted(
                tuple(state["position"][step, :2].astype(float).tolist())
                for state in tracks.values()
                if state["valid"][step]
            )
            assert found == logged
            if not env.agents:
                break
            advance(env, 1)
        assert step > 60


def test_poses_between_samples_are_interpolated(scene: Path) -> None:
    overrides = {"clock.ctrl_dt_s": 0.05}
    with closing(made(scene, overrides=overrides)) as env:
        advance(env, 7)
        first = rows_of(env, DRIVER_EXTERNAL)[0]
        assert first["x"] == pytest.approx(80.0 - 8.0 * 0.35, abs=1e-4)
        assert first["speed"] == pytest.approx(8.0, abs=1e-3)


def test_vehicles_of_agents_are_chosen_by_name_or_in_the_order_of_the_file(scene: Path) -> None:
    with closing(made(scene, agents=2)) as env:
        assert rows_of(env, DRIVER_AGENT)["x"] == pytest.approx([-60.0, 80.0], abs=1e-4)
    seats = {"scenario.seats": ["8", "7"]}
    with closing(made(scene, agents=2, overrides=seats)) as env:
        assert rows_of(env, DRIVER_AGENT)["x"] == pytest.approx([80.0, -60.0], abs=1e-4)
    late = {"scenario.seats": ["9"], "scenario.params": {"start_s": 3.0}}
    with closing(made(scene, overrides=late)) as env:
        (agent,) = rows_of(env, DRIVER_AGENT)
        assert agent["y"] == pytest.approx(-95.0 + 27.0, abs=1e-4)
        assert env.config.max_steps == TIMES - 1 - 30


def test_an_agent_drives_to_its_logged_goal(scene: Path) -> None:
    with closing(made(scene)) as env:
        place_m = -60.0
        while env.agents:
            (agent,) = rows_of(env, DRIVER_AGENT)
            place_m = float(agent["x"])
            advance(env, 1)
        assert place_m > 15.0


def test_drivers_that_react_follow_the_logged_way(scene: Path) -> None:
    with closing(made(scene, overrides=REACTIVE)) as env:
        (driven,) = rows_of(env, DRIVER_BACKGROUND)
        assert (driven["x"], driven["speed"]) == pytest.approx((80.0, 8.0), abs=1e-4)
        advance(env, 40)
        driven = rows_of(env, DRIVER_BACKGROUND)
        assert len(driven) == 2  # vehicle 9 has entered at its logged time
        assert driven["order"].tolist() == [0, 1]
        assert len(rows_of(env, DRIVER_EXTERNAL)) == 3


def test_a_driver_that_reacts_stops_behind_a_standing_agent(scene: Path, tmp_path: Path) -> None:
    """A replayed vehicle would drive through the agent."""
    follower = scenario()
    follower["tracks"] = {
        "7": track(-60.0, -ASIDE_M, 10.0, 0.0),
        "8": track(-90.0, -ASIDE_M, 10.0, 0.0),
    }
    path = write_pickle(tmp_path, follower)
    contacts = []
    for params in ({}, REACTIVE):
        with closing(made(path, overrides=params)) as env:
            for _ in range(60):
                if not env.agents:
                    break
                env.step({"car_0": np.array([-1.0, 0.0], np.float32)})
            contacts.append(env.simulation.traffic_stats().contacts)
    assert contacts[0] > 0
    assert contacts[1] == 0


def hashes(scene: Path, kill_at: tuple[int, ...] = (), **more: Any) -> list[str]:
    with closing(parallel_env(scene, **more)) as env:
        env.reset(seed=3)
        found = [env.state_hash()]
        for step in range(70):
            actions = env.suggest_actions()
            if step in kill_at:
                os.kill(env.worlds.worker_pids[1], signal.SIGKILL)
            env.step(actions)
            found.append(env.state_hash())
            if not env.agents:
                break
        assert len(found) > 40
        return found


@pytest.mark.parametrize("params", [{}, {"reactive": True}, {"start_s": 1.0}])
@pytest.mark.parametrize("seats", [["8"], ["7", "8"]])
def test_zones_and_workers_change_no_result(
    scene: Path, seats: list[str], params: dict[str, Any]
) -> None:
    overrides = {
        "scenario.params": params, "scenario.seats": seats, "zones.check_invariants": True
    }  # fmt: skip
    whole = hashes(scene, agents=len(seats), overrides=overrides)
    for zones, workers in ((2, 0), (4, 0), (4, 2)):
        divided = hashes(
            scene, overrides=overrides, zones=zones, workers=workers, agents=len(seats)
        )
        assert divided == whole


@pytest.mark.parametrize(
    ("overrides", "driver"), [({}, DRIVER_EXTERNAL), (REACTIVE, DRIVER_BACKGROUND)]
)
def test_logged_vehicles_change_their_zone(
    scene: Path, overrides: dict[str, Any], driver: int
) -> None:
    """The equivalence of divided worlds includes vehicles that cross borders."""
    with closing(made(scene, overrides={"scenario.seats": ["8"], **overrides}, zones=2)) as env:
        owners = []
        for _ in range(70):
            rows = rows_of(env, driver)
            vehicle = rows[np.argmin(rows["id"])]["id"]  # logged as 7
            owners.append(
                next(
                    zone
                    for zone, shard in enumerate(env.simulation.shards)
                    if vehicle in shard.worlds.rows[0, : shard.worlds.num_owned[0]]["id"]
                )
            )
            if not env.agents:
                break
            advance(env, 1)
        assert len(set(owners)) == 2


@pytest.mark.filterwarnings("ignore:workers = ")
def test_a_successor_of_a_dead_worker_continues(scene: Path) -> None:
    whole = hashes(scene, overrides=REACTIVE)
    assert hashes(scene, overrides=REACTIVE, zones=2, workers=2, kill_at=(5, 21)) == whole


@pytest.mark.slow
def test_nodes_change_no_result(scene: Path) -> None:
    for overrides in ({}, REACTIVE):
        whole = hashes(scene, overrides=overrides)
        assert hashes(scene, overrides=overrides, zones=2, nodes=2) == whole
        assert hashes(scene, overrides=overrides, zones=2, nodes=2, kill_at=(24,)) == whole


def test_new_episodes_of_a_vectorized_environment_do_not_depend_on_zones(
    scene: Path,
) -> None:
    with closing(make_vec(scene, num_envs=3, overrides=REACTIVE)) as vec:
        vec.reset(seed=0)
        for _ in range(TIMES + 20):
            vec.step(vec.suggest_actions())
        again = [vec.state_hash(w) for w in range(3)]
    with closing(make_vec(scene, num_envs=3, zones=2, overrides=REACTIVE)) as vec:
        vec.reset(seed=0)
        for _ in range(TIMES + 20):
            vec.step(vec.suggest_actions())
        assert [vec.state_hash(w) for w in range(3)] == again


@pytest.mark.parametrize("overrides", [{}, REACTIVE])
def test_a_saved_state_continues_with_other_zones(scene: Path, overrides: dict[str, Any]) -> None:
    def finished(first: int, saved: bytes | None, zones: int) -> tuple[str, bytes]:
        with closing(make_vec(scene, zones=zones, overrides=overrides)) as vec:
            vec.reset(seed=1)
            if saved is not None:
                vec.load_state(saved)
            kept = b""
            for step in range(first, 50):
                if step == 25:
                    kept = vec.save_state()
                vec.step(vec.suggest_actions())
            return vec.state_hash(0), kept

    wanted, saved = finished(0, None, 1)
    assert finished(25, saved, 1)[0] == wanted
    assert finished(25, saved, 2)[0] == wanted


def test_a_recorded_run_is_repeated(scene: Path, tmp_path: Path) -> None:
    record = RecordOptions(tmp_path / "run", include=(INPUTS,))
    with closing(parallel_env(scene, overrides=REACTIVE, record=record)) as env:
        env.reset(seed=0)
        advance(env, 30)
        wanted = env.state_hash()
        seen = env.world_frames([0])[0].vehicles["x"]
    frame = list(Recording.open(tmp_path / "run").frames())[-1]
    assert sorted(frame.vehicles["x"].tolist()) == sorted(seen.tolist())
    for zones in (1, 2):
        found = repeat_recording(
            tmp_path / "run", WorldSpec.of(scene, overrides=REACTIVE), zones=zones
        )
        assert (found.first_difference, found.state_hash) == (None, wanted)


def test_a_recorded_run_is_repeated_with_a_moved_scene_file_only_if_its_content_is_equal(
    scene: Path, tmp_path: Path
) -> None:
    record = RecordOptions(tmp_path / "run", include=(INPUTS,))
    with closing(parallel_env(scene, record=record)) as env:
        env.reset(seed=0)
        advance(env, 10)
        wanted = env.state_hash()
    moved = tmp_path / "moved"
    moved.mkdir()
    (moved / scene.name).write_bytes(scene.read_bytes())
    found = repeat_recording(tmp_path / "run", WorldSpec.of(moved / scene.name))
    assert (found.first_difference, found.state_hash) == (None, wanted)
    changed = scenario()
    changed["tracks"]["8"]["state"]["position"][:, 0] += 1.0
    with pytest.raises(ConfigError, match="was recorded on another map"):
        repeat_recording(tmp_path / "run", WorldSpec.of(write_pickle(moved, changed)))


def test_the_caller_can_pose_vehicles_beside_the_replayed_ones(scene: Path) -> None:
    with closing(made(scene, overrides={"population.external": 2})) as env:
        slot = env.external.spawn(-30.0, 40.0, 0.0)
        advance(env, 3)
        assert len(env.external.vehicles()) == 1
        assert env.external.ids()[slot] == env.external.vehicles()["id"][0]
        assert len(env.external.ids()) == 2
        assert len(rows_of(env, DRIVER_EXTERNAL)) == 5
        env.external.remove(slot)
        advance(env, 1)
        assert len(rows_of(env, DRIVER_EXTERNAL)) == 4


def test_a_folder_can_name_a_scene(tmp_path: Path) -> None:
    write_json_scene(tmp_path)
    (tmp_path / "env.yaml").write_text(
        f"name: {tmp_path.name}\nmap: {{source: made.json}}\nscenario: {{name: made.json}}\n"
        "population: {agents: 2, background: 0}\ntraffic: {min_trip_m: 0}\nhorizon_s: 5\n",
        encoding="utf-8",
    )
    with closing(made(tmp_path)) as env:
        assert len(rows_of(env, DRIVER_AGENT)) == 2
        assert env.config.max_steps == 50


def test_large_bodies_are_reduced_and_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    scene = scenario()
    scene["tracks"]["8"]["state"]["length"][:] = 18.0
    with caplog.at_level(logging.WARNING), closing(made(write_pickle(tmp_path, scene))) as env:
        assert max(rows_of(env, DRIVER_EXTERNAL)["length"]) == 12.0
    assert "1 road users are larger than a bus" in caplog.text


WRONG: dict[str, tuple[dict[str, Any], type[Exception], str]] = {
    "unknown seat": ({"scenario.seats": ["x"]}, ConfigError, "'x' is not a track of the scene"),
    "walker": ({"scenario.seats": ["walker"]}, ConfigError, "is a pedestrian, not a vehicle"),
    "late": ({"scenario.seats": ["9"]}, ConfigError, "was not seen at 0 s"),
    "parked": ({"scenario.seats": ["parked"]}, ConfigError, "is not on a lane in its direction"),
    "two seats": ({"scenario.seats": ["7", "8"]}, ConfigError, "name one track per agent"),
    "twice": (
        {"scenario.seats": ["7", "7"], "population.agents": 2}, ConfigError, "at most once"
    ),
    "many": ({"population.agents": 3}, ScenarioError, "only 2 vehicles of the scene 'made'"),
    "start": ({"scenario.params": {"start_s": 9.0}}, ConfigError, "must be before the last sample"),
    "param": ({"scenario.params": {"begin": 1.0}}, ConfigError, "has no such parameter"),
    "background": ({"population.background": 3}, ConfigError, "has its own vehicles"),
    "mode": ({"population.mode": "respawn"}, ConfigError, "population.mode = 'respawn'"),
    "network": (
        {**REACTIVE, "traffic.model": {"IDM": 1.0, "Krauss": 1.0}},
        ConfigError,
        "name one car-following model",
    ),
    "other": ({"scenario.name": "", "scenario.seats": ["7"]}, ConfigError, "needs a logged scene"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_invalid_settings_are_refused_with_a_remedy(name: str, scene: Path) -> None:
    overrides, kind, message = WRONG[name]
    with pytest.raises(kind) as caught:
        parallel_env(scene, overrides=overrides)
    assert message in str(caught.value)


def test_an_agent_in_a_vehicle_that_overlaps_another_one_is_refused(tmp_path: Path) -> None:
    scene = scenario()
    scene["tracks"]["twin"] = track(-58.0, -ASIDE_M, 10.0, 0.0)
    path = write_pickle(tmp_path, scene)
    with pytest.raises(ConfigError, match=r"'7' overlaps another road user at 0 s; use another"):
        parallel_env(path, overrides={"scenario.seats": ["7"]})
    with closing(made(path)) as env:  # without a name, the agent gets another vehicle
        assert rows_of(env, DRIVER_AGENT)["x"] == pytest.approx([80.0], abs=1e-4)


def test_the_goal_of_an_agent_is_on_the_diverging_lane_that_the_log_follows(tmp_path: Path) -> None:
    lines = lane_lines()
    line = np.concatenate([lines["tWN"], lines["outN"][1:]])[:, :2]
    steps = np.diff(line, axis=0)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))])
    at = 1.0 + 0.5 * np.arange(TIMES)
    heading = np.interp(at, along[:-1], np.arctan2(steps[:, 1], steps[:, 0]))
    turner = track(0.0, 0.0, 1.0, 0.0)
    for axis, aside in enumerate((np.sin(heading), -np.cos(heading))):  # 0.5 m to the right
        turner["state"]["position"][:, axis] = np.interp(at, along, line[:, axis]) + 0.5 * aside
    turner["state"]["heading"][:] = heading
    scene = scenario()
    scene["tracks"] = {"turner": turner}
    world = load_world(write_pickle(tmp_path, scene), overrides={"scenario.seats": ["turner"]})
    found = plan_scene(world.config.scenario, world.network, 1)
    assert found is not None
    matcher = LaneMatcher(world.network)
    x, y = turner["state"]["position"][-1, :2].tolist()
    end = matcher.place(x, y, float(heading[-1]))
    assert end is not None
    assert found.seats[0].goal_edge == matcher.edge(end.lane, is_start=False)


def test_a_missing_or_hostile_file_is_refused_with_a_typed_error(tmp_path: Path) -> None:
    with pytest.raises(UnknownEnvironmentError):
        parallel_env(tmp_path / "none.pkl")
    (tmp_path / "bad.pkl").write_bytes(b"cos\nsystem\n(S'true'\ntR.")
    with pytest.raises(MapError, match="only builtins"):
        parallel_env(tmp_path / "bad.pkl")
