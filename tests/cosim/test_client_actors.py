"""Actors that clients bring into a world: they enter, move, are seen, and leave."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cavmarl
from cavmarl.core.errors import FollowerError
from cavmarl.core.records.codes import DRIVER_EXTERNAL
from cavmarl.core.records.external_records import FIRST_EXTERNAL_ID
from cavmarl.cosim.followers.followed_world import FollowedWorld
from cavmarl.cosim.followers.follower_client import Follower
from cavmarl.cosim.followers.follower_messages import ActorRequest, PoseView
from tests.cosim.conftest import hashes, steer

Start = Callable[[Callable[[], Any]], threading.Thread]

STEP_S = 0.05
SETTINGS = {
    "population.mode": "respawn", "clock.ctrl_dt_s": STEP_S, "horizon_s": 60,
    "population.external": 3,
}  # fmt: skip
BODIES = ("car", "truck", "bus", "pedestrian", "cyclist", "roadside_unit")


def make_env(name: str = "ring", zones: int = 1, workers: int = 0, **more: Any) -> cavmarl.CavEnv:
    return cavmarl.parallel_env(
        name, agents=2, background=6, zones=zones, workers=workers, overrides=SETTINGS | more
    )


def far_place(env: cavmarl.CavEnv) -> tuple[float, float]:
    """Return a place at the edge of the map that no vehicle can see."""
    min_x, min_y, _, _ = env.network.extent_m
    return min_x - 90.0, min_y - 90.0


def request(x: float, y: float, kind: str = "car", **more: Any) -> ActorRequest:
    return ActorRequest("own", kind, x, y, 0.0, **more)


@contextmanager
def joined(world: FollowedWorld, *actors: ActorRequest, **more: Any) -> Iterator[Follower]:
    """Yield a follower that has joined the world with actors."""
    found: list[Follower] = []

    def call() -> None:
        found.append(Follower(world.address, [], "client", 10.0, actors=actors, **more))

    caller = threading.Thread(target=call)
    caller.start()
    before = len(world.seats)
    while len(world.seats) == before and caller.is_alive():
        world.admit(0.1)
    caller.join()
    with found[0] as follower:
        yield follower


def refusal(world: FollowedWorld, *actors: ActorRequest, **more: Any) -> str:
    """Return the reason that the world gives when it refuses a follower with actors."""
    reasons: list[str] = []

    def call() -> None:
        try:
            Follower(world.address, more.pop("vehicles", []), "bad", actors=actors, **more)
        except FollowerError as error:
            reasons.append(str(error))

    caller = threading.Thread(target=call)
    caller.start()
    while caller.is_alive():
        world.admit(0.05)
    caller.join()
    return reasons[0]


def others(env: cavmarl.CavEnv) -> bytes:
    """Return the bytes of all vehicles except actors of clients, sorted by id."""
    rows = env.simulation.vehicles()
    rows = rows[rows["driver"] != DRIVER_EXTERNAL]
    return bytes(rows[np.argsort(rows["id"])].tobytes())


@pytest.mark.parametrize("kind", BODIES)
def test_an_actor_enters_in_the_next_step_and_leaves_with_its_client(
    address: Path, kind: str
) -> None:
    env = make_env()
    with FollowedWorld(env, address) as world:
        world.reset(seed=1)
        world.step()
        x, y = far_place(env)
        with joined(world, request(x, y, kind), waits=False) as follower:
            world.step()
            (row,) = env.external.vehicles()
            assert (row["x"], row["y"], row["id"]) == (x, y, env.external.ids()[0])
            assert row["id"] >= FIRST_EXTERNAL_ID
            assert row["vtype"] == env.simulation.type_rows[kind]
            first, second = follower.wait(), follower.wait()
            assert first is not None
            assert second is not None
            assert first.snapshot.actors["own"].vehicle_id == -1
            seen = second.snapshot.actors["own"]
            assert (seen.vehicle_id, seen.x, seen.y) == (row["id"], x, y)
        world.step()  # in this step the world detects that the socket is closed
        world.step()
        assert len(env.external.vehicles()) == 0
        assert (env.external.ids() == -1).all()
        assert world.seats == ()
        assert [entry["type"] for entry in world.actors.report()] == [kind]


def test_an_actor_that_no_vehicle_sees_does_not_change_other_vehicles(
    address: Path,
) -> None:
    """Compare runs in which vehicles depart and arrive, so that vehicles get new ids."""
    runs = []
    for brings in (False, True):
        env = make_env("merge", horizon_s=40, **{"population.mode": "open", "population.budget": 8})
        found = []
        with FollowedWorld(env, address) as world:
            world.reset(seed=3)
            for step in range(300):
                if step == 5 and brings:
                    x, y = far_place(env)
                    client = joined(world, request(x, y, rate_hz=20.0), waits=False)
                    follower = client.__enter__()
                if brings and 5 < step < 200:
                    pose = PoseView(step * STEP_S, x + 0.01 * step, y, 0.1)
                    follower.send_poses({"own": [pose]})
                if step == 200 and brings:
                    client.__exit__(None, None, None)
                if world.is_over:
                    break
                world.step()
                found.append(others(env))
            assert env.traffic_stats()["arrived"] > 0
        runs.append(found)
    assert runs[0] == runs[1]


def test_a_pose_moves_an_actor_in_the_step_that_ends_at_its_time(address: Path) -> None:
    env = make_env()
    with FollowedWorld(env, address) as world:
        world.reset(seed=1)
        x, y = far_place(env)
        with joined(world, request(x, y, rate_hz=20.0), waits=False) as follower:
            world.step()
            for step in range(1, 6):
                pose = PoseView((step + 1) * STEP_S, x + 0.4 * step, y, 0.0)
                follower.send_poses({"own": [pose]})
                world.step()
                (row,) = env.external.vehicles()
                assert (row["x"], row["y"]) == (pose.x, y)
                assert row["speed"] == pytest.approx(8.0)
            for ahead in range(1, 4):  # without new poses, the actor moves on at its last speed
                world.step()
                (row,) = env.external.vehicles()
                assert row["x"] == pytest.approx(x + 2.0 + 0.4 * ahead)
        counts = world.seats[0].actors[0].track.counts
        assert (counts.received, counts.late, counts.lost) == (5, 0, 0)
        assert (counts.extrapolated, counts.stopped) == (3, 0)


def test_the_world_waits_for_a_client_that_answers_with_poses(address: Path, start: Start) -> None:
    env = make_env()
    with FollowedWorld(env, address) as world:
        world.reset(seed=1)
        x, y = far_place(env)

        def walk() -> None:
            walker = request(x, y, "pedestrian", rate_hz=40.0)
            with Follower(address, [], "walker", actors=[walker]) as follower:
                for view in follower:
                    time.sleep(0.01)
                    now_s = view.snapshot.time_s
                    poses = [
                        PoseView(now_s + ahead_s, x + now_s + ahead_s, y, 0.0)
                        for ahead_s in (0.025, 0.05)
                    ]
                    follower.answer(poses={"own": poses})

        start(walk)
        world.wait_for(1, 10.0)
        for step in range(1, 8):
            world.step()
            (row,) = env.external.vehicles()
            assert row["x"] == pytest.approx(x + step * STEP_S)
        counts = world.seats[0].actors[0].track.counts
        assert (counts.late, counts.lost, counts.extrapolated) == (0, 0, 0)
        assert world.seats[0].wait_wall_s > 0.05


def test_controls_drive_an_actor_as_they_drive_an_agent(address: Path, start: Start) -> None:
    env = make_env()
    with FollowedWorld(env, address) as world:
        world.reset(seed=1)
        x, y = far_place(env)

        def drive() -> None:
            with Follower(
                address, ["car_0"], "both", actors=[request(x, y, moved_by="controls")]
            ) as follower:
                for view in follower:
                    controls = steer(view)
                    if view.snapshot.frame == 1:
                        controls["own"] = [
                            0.4,
                            0.0,
                        ]  # these controls hold until the client sends others
                    follower.answer(controls)

        start(drive)
        world.wait_for(1, 10.0)
        hashes(world, 11)
        (row,) = env.external.vehicles()
        assert row["speed"] == pytest.approx(0.4 * env.config.action.acceleration_mps2 * 0.5)
        assert row["x"] > x
        assert world.seats[0].agents == (0,)


def test_an_actor_that_is_placed_on_an_agent_collides_with_it(address: Path) -> None:
    env = make_env()
    with FollowedWorld(env, address) as world:
        world.reset(seed=1)
        agent = env.simulation.vehicles()
        agent = agent[agent["agent"] == 0][0]
        x, y = far_place(env)
        with joined(world, request(x, y), waits=False) as follower:
            world.step()
            # The pose is far away, so the actor leaves and enters again on the agent.
            pose = PoseView(0.1, float(agent["x"]), float(agent["y"]), float(agent["heading"]))
            follower.send_poses({"own": [pose]})
            hits = []
            for _ in range(3):
                world.step()
                hits += [int(row["hit"]) for row in env.external.vehicles()]
        assert int(agent["id"]) in hits


def test_refused_requests_get_a_reason_and_change_nothing(address: Path) -> None:
    env = make_env()
    with FollowedWorld(env, address) as world:
        world.reset(seed=1)
        before = env.state_hash()
        x, y = far_place(env)
        row = env.simulation.vehicles()[0]
        there = float(row["x"]), float(row["y"])
        for actors, match in (
            ([request(*there)], "occupied by another vehicle; give a free place"),
            ([request(x, y, "tank")], "vtype = 'tank': must be one of car, truck"),
            ([request(math.nan, y)], "x = nan: must be a finite number"),
            ([request(x - 1e5, y)], "outside of the map"),
            ([request(x, y, size_m=[1.0, 2.0])], "size_m has 2 numbers"),
            ([request(x, y, size_m=[40.0, 2.0, 2.0])], "at most those of a bus"),
            ([request(x, y, moved_by="magic")], "must be one of poses, controls, nothing"),
            ([request(x, y, rate_hz=-1.0)], "rate_hz = -1"),
            ([request(x, y, rig=["roof"])], "population.external_agents = true"),
            ([request(x, y), request(x + 20.0, y)], "'own' is named twice"),
            ([ActorRequest("car_0", "car", x, y, 0.0)], "an agent's; use another"),
            (
                [ActorRequest(f"a{k}", "car", x + 20.0 * k, y, 0.0) for k in range(4)],
                r"all 3 places of population\.external are in use",
            ),
        ):
            assert match.replace("\\", "") in refusal(world, *actors), match
        assert "the world has to wait" in refusal(world, vehicles=["car_0"], waits=False)
        assert world.seats == ()
        assert env.state_hash() == before
        # The refused requests have left all places free.
        with joined(
            world,
            *(ActorRequest(f"a{k}", "car", x + 20.0 * k, y, 0.0) for k in range(3)),
            waits=False,
        ):
            world.step()
            assert len(env.external.vehicles()) == 3


def test_the_refusal_of_a_world_without_places_for_actors_names_the_setting(address: Path) -> None:
    env = make_env(**{"population.external": 0})
    with FollowedWorld(env, address) as world:
        world.reset(seed=1)
        assert "set population.external" in refusal(world, request(0.0, 0.0))


@pytest.mark.parametrize(
    ("poses", "match"),
    [
        ({"own": [PoseView(1e3, 0.0, 0.0, 0.0)]}, "is in the future"),
        ({"own": [PoseView(0.0, math.nan, 0.0, 0.0)]}, "x = nan"),
        ({"other": [PoseView(0.0, 0.0, 0.0, 0.0)]}, "poses of other, which is not its actor"),
    ],
)
def test_a_client_with_invalid_poses_is_dropped_with_its_actor(
    address: Path, poses: Any, match: str
) -> None:
    env = make_env()
    with FollowedWorld(env, address) as world:
        world.reset(seed=1)
        with joined(world, request(*far_place(env)), waits=False) as follower:
            world.step()
            follower.send_poses(poses)
            with pytest.raises(FollowerError, match=match):
                world.step()
            world.step()
            assert world.seats == ()
            assert len(env.external.vehicles()) == 0
            assert (
                follower.wait() is not None
            )  # the frames before and after the first step of this client
            assert follower.wait() is not None
            with pytest.raises(FollowerError, match=match):
                follower.wait()


def test_invalid_poses_can_be_ignored_and_counted(address: Path) -> None:
    env = make_env()
    with FollowedWorld(env, address, bad_controls="hold") as world:
        world.reset(seed=1)
        with joined(world, request(*far_place(env)), waits=False) as follower:
            world.step()
            follower.send_poses({"own": [PoseView(1e3, 0.0, 0.0, 0.0)]})
            world.step()
            assert world.seats[0].bad == 1
            assert len(env.external.vehicles()) == 1


def test_a_client_that_poses_its_actor_outside_of_the_map_is_dropped(address: Path) -> None:
    env = make_env()
    with FollowedWorld(env, address) as world:
        world.reset(seed=1)
        with joined(world, request(*far_place(env)), waits=False) as follower:
            world.step()
            follower.send_poses({"own": [PoseView(0.05, 1e6, 0.0, 0.0)]})
            world.step()
            world.step()
            assert world.seats == ()
            assert len(env.external.vehicles()) == 0


def test_a_client_that_does_not_read_misses_snapshots_but_does_not_delay_the_world(
    address: Path,
) -> None:
    env = make_env(horizon_s=600)
    with FollowedWorld(env, address, truth=True) as world:
        world.reset(seed=1)
        with joined(world, request(*far_place(env)), waits=False, truth=True):
            began = time.monotonic()
            for _ in range(2000):
                world.step()
                if world.seats[0].unseen:
                    break
            assert world.seats[0].unseen > 0
            assert world.seats[0].wait_wall_s == 0.0
            assert time.monotonic() - began < 60.0


def test_actors_enter_again_in_the_next_episode(address: Path) -> None:
    env = make_env()
    with FollowedWorld(env, address) as world:
        x, y = far_place(env)
        with joined(world, request(x, y, rate_hz=20.0), waits=False) as follower:
            for seed in (1, 2):
                world.reset(seed=seed)
                world.step()
                (row,) = env.external.vehicles()
                assert row["x"] == x
                follower.send_poses({"own": [PoseView(0.1, x + 1.0, y, 0.0)]})
                world.step()
                (row,) = env.external.vehicles()
                assert row["x"] == x + 1.0


def run_with_clients(address: Path, zones: int, backend: str) -> list[str]:
    """Run a world in lock step with a client whose actors cross zones; return the state hashes."""
    env = cavmarl.parallel_env(
        "grid4x4",
        agents=2,
        background=20,
        zones=zones,
        backend=backend,
        overrides=SETTINGS | {"zones.check_invariants": zones > 1},
    )
    min_x, min_y, max_x, max_y = env.network.extent_m
    x, y = 0.5 * (min_x + max_x), 0.5 * (min_y + max_y)

    def crossing() -> None:
        actors = [
            ActorRequest("fast", "truck", x - 80.0, y + 30.0, 0.0, rate_hz=20.0),
            ActorRequest("driven", "car", x - 15.0, y - 7.0, 0.0, speed=15.0, moved_by="controls"),
        ]
        with Follower(address, [], "crossing", actors=actors) as follower:
            for k, view in enumerate(follower):
                if view.snapshot.is_over:
                    continue
                end_s = view.snapshot.time_s + STEP_S
                pose = PoseView(end_s, x - 80.0 + 2.8 * k, y + 30.0, 0.0)
                controls = {"driven": [0.2, 0.01]}
                poses = {} if k % 7 == 3 else {"fast": [pose]}
                follower.answer(controls, poses)

    thread = threading.Thread(target=crossing)
    with closing(env), FollowedWorld(env, address) as world:
        world.reset(seed=2)
        thread.start()
        world.wait_for(1, 10.0)
        found = hashes(world, 60)
        assert world.actors.report()[0]["extrapolated"] > 3
        if zones > 1 and "nodes" not in backend:  # both actors have changed their zone
            assert (env.external.vehicles()["epoch"] > 0).all()
    thread.join(10.0)
    return found


def test_actors_cross_zones_and_workers_without_a_changed_bit(tmp_path: Path) -> None:
    undivided = run_with_clients(tmp_path / "a", 1, "local")
    assert run_with_clients(tmp_path / "b", 4, "local") == undivided
    assert run_with_clients(tmp_path / "c", 4, "processes:2") == undivided


@pytest.mark.slow
def test_actors_cross_nodes_without_a_changed_bit(tmp_path: Path) -> None:
    undivided = run_with_clients(tmp_path / "a", 1, "local")
    assert run_with_clients(tmp_path / "b", 4, "nodes:2") == undivided
