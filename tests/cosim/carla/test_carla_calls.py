"""Each call has an answer in CARLA's format, and calls with errors do not change the world."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cavmarl.cosim.carla.call_arguments import CallRefused
from cavmarl.cosim.carla.call_table import CALLS, Caller, Returns, answer
from cavmarl.cosim.carla.carla_geometry import CarlaPose
from cavmarl.cosim.carla.carla_session import CarlaSession, OtherTicks, SessionLimits
from cavmarl.cosim.carla.carla_versions import client_version
from tests.cosim.carla.conftest import VERSION, Call, make_server

POSE = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
GNSS = [1, "sensor.other.gnss", []]
WRONG: list[Any] = [None, "text", -1, 1 << 70, math.nan, [[]], [math.inf] * 3, b"x", {}, True]


def car_0(session: CarlaSession) -> int:
    actor = session.actors.of_agent(0)
    assert actor is not None
    return actor.number


@pytest.mark.parametrize("name", sorted(CALLS))
def test_a_wrong_number_of_arguments_is_an_error_in_the_format_of_the_call(
    session: CarlaSession, name: str
) -> None:
    known = CALLS[name]
    error, result = answer(Caller("test"), session, name, [None] * (len(known.checks) + 1))
    assert error is None
    mark = True if known.returns is Returns.NOTHING else 0
    assert result[0][0] == mark
    assert f"{name}: {len(known.checks) + 1} arguments" in result[0][1][0]


@pytest.mark.parametrize("name", sorted(name for name in CALLS if CALLS[name].checks))
def test_arguments_of_wrong_types_have_an_answer_and_change_nothing(
    session: CarlaSession, name: str
) -> None:
    known = CALLS[name]
    before, frame = session.world.env.state_hash(), session.frame
    for value in WRONG:
        error, result = answer(Caller("test"), session, name, [value] * len(known.checks))
        assert error is None
        assert isinstance(result, list)
    assert (session.world.env.state_hash(), session.frame) == (before, frame)


def test_an_unknown_call_returns_the_error_of_rpclib(session: CarlaSession) -> None:
    error, result = answer(Caller("test"), session, "fly", [1, 2])
    assert error == "rpclib: server could not find function 'fly' with argument count 3."
    assert result is None


def test_an_internal_error_is_returned_to_the_client_and_logged(
    session: CarlaSession,
    call: Call,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(session.actors, "spectator", None)
    with pytest.raises(RuntimeError, match="internal error in get_spectator: AttributeError"):
        call("get_spectator")
    assert "get_spectator" in caplog.text


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e7])
def test_poses_outside_of_the_world_are_refused(
    session: CarlaSession, call: Call, value: float
) -> None:
    pose = [[value, 0.0, 0.0], [0.0, 0.0, 0.0]]
    for name, arguments in (
        ("spawn_actor", (GNSS, pose)),
        ("set_actor_transform", (session.actors.spectator.number, pose)),
    ):
        with pytest.raises(RuntimeError, match=r"not a finite number|beyond 1e\+06 m"):
            call(name, *arguments)


def test_attributes_that_can_be_changed_have_recommended_values(call: Call) -> None:
    for _, type_id, tags, attributes in call("get_actor_definitions"):
        assert set(tags.split(",")) == set(type_id.split("."))
        for name, kind, default, recommended, can_change, _ in attributes:
            first = client_version(VERSION).first_attribute_kind
            assert first <= kind <= first + 4
            assert not can_change or recommended, f"{type_id}: {name} = {default}"


def test_sensors_that_are_not_available_are_refused_by_name(call: Call) -> None:
    with pytest.raises(RuntimeError, match=r"sensor\.camera\.dvs is not available"):
        call("spawn_actor", [1, "sensor.camera.dvs", []], POSE)


def test_a_sensor_lives_until_it_is_destroyed(session: CarlaSession, call: Call) -> None:
    parent = car_0(session)
    number, attached_to, (_, type_id, _), _, _, token = call(
        "spawn_actor_with_parent", GNSS, POSE, parent, 0, ""
    )
    assert (attached_to, type_id, len(token)) == (parent, "sensor.other.gnss", 24)
    assert [one[0] for one in call("get_actors_by_id", [number, 999_999])] == [number]
    assert call("destroy_actor", number)
    with pytest.raises(RuntimeError, match="unable to destroy actor: not found"):
        call("destroy_actor", number)


def test_a_sensor_with_an_invalid_attribute_is_not_spawned(
    session: CarlaSession, call: Call
) -> None:
    what = [1, "sensor.lidar.ray_cast", [["channels", 2, "many"]]]
    before = len(session.actors.actors)
    with pytest.raises(RuntimeError, match="channels = 'many': must be a number from 1 to 512"):
        call("spawn_actor", what, POSE)
    assert len(session.actors.actors) == before


def test_the_number_of_sensors_is_limited() -> None:
    with make_server(limits=SessionLimits(max_actors=2)) as server:
        session = server.session
        for _ in range(2):
            session.spawn("sensor.other.imu", {}, CarlaPose(0.0, 0.0, 0.0))
        with pytest.raises(CallRefused, match="2 actors are spawned; destroy some first"):
            session.spawn("sensor.other.imu", {}, CarlaPose(0.0, 0.0, 0.0))


def test_vehicles_of_the_world_are_not_moved_or_destroyed(
    session: CarlaSession, call: Call
) -> None:
    number = car_0(session)
    with pytest.raises(RuntimeError, match="belongs to the world"):
        call("destroy_actor", number)
    with pytest.raises(RuntimeError, match="vehicles of the world move by themselves"):
        call("set_actor_transform", number, POSE)


def test_a_call_for_an_unknown_actor_is_an_error(call: Call) -> None:
    with pytest.raises(RuntimeError, match="Actor could not be found in the registry"):
        call("apply_control_to_vehicle", 10**6, [0.0, 0.0, 0.0, False, False, False, 0])


def test_a_control_drives_an_agent_until_its_client_leaves(session: CarlaSession) -> None:
    number, caller = car_0(session), Caller("a client that leaves")
    control = [0.0, 0.0, 1.0, False, False, False, 0]
    for _ in range(60):
        answer(caller, session, "apply_control_to_vehicle", [number, control])
        session.tick()
    state = session.actors.state_of(session.actors.actors[number])
    assert state is not None
    assert state["brake"] == 1.0
    assert np.linalg.norm(state["velocity"]) < 0.1
    session.release(caller)
    assert 0 not in session.world.controls


def test_only_agents_are_driven(session: CarlaSession, call: Call) -> None:
    other = next(one for one in session.actors.vehicles if one.agent < 0)
    with pytest.raises(RuntimeError, match="only agents can be controlled"):
        call("apply_control_to_vehicle", other.number, [1.0, 0.0, 0.0, False, False, False, 0])


def test_a_batch_answers_each_command_in_order(session: CarlaSession, call: Call) -> None:
    light = int(session.actors.lights["id"][0])
    spawn = [0, [GNSS, POSE, [False, 208], 0, "", [[[6, [0, POSE]]]]]]
    answers = call(
        "apply_batch",
        [[spawn], [[21, [light, 2]]], [[18, [car_0(session), 3]]], [[99, [1]]], [[1, []]]],
        False,
    )
    assert [one[0][0] for one in answers] == [1, 1, 1, 0, 0]
    assert call("destroy_actor", answers[0][0][1])
    assert call("get_vehicle_light_state", car_0(session)) == [3]


def test_settings_are_kept_and_impossible_steps_are_refused(
    session: CarlaSession, call: Call
) -> None:
    rest = [True, 0.01, 10, 0.0, True, 3000.0, 2000.0, True]
    assert call("set_episode_settings", [True, False, [True, 0.1], *rest]) == session.frame
    assert call("get_episode_settings")[:3] == [True, False, [True, 0.1]]
    tick = session.world.master.tick
    frame = call("tick_cue")
    assert (frame, session.world.master.tick - tick) == (session.frame, 2)  # steps of 0.05 s
    with pytest.raises(RuntimeError, match=r"fixed_delta_seconds = 60: must be from 0.001 to 10"):
        call("set_episode_settings", [True, False, [True, 60.0], *rest])
    assert call("get_episode_settings")[2] == [True, 0.1]
    call("set_episode_settings", [False, False, [False], *rest])
    assert call("tick_cue") == session.frame + 1


@pytest.mark.parametrize("other_ticks", ["obey", "refuse", "follow"])
def test_ticks_of_a_second_client_are_detected(
    other_ticks: OtherTicks, caplog: pytest.LogCaptureFixture
) -> None:
    with make_server(agents=1, background=0, other_ticks=other_ticks) as server:
        session = server.session
        session.settings = replace(session.settings, synchronous=True)
        first, second = Caller("first"), Caller("second")
        assert answer(first, session, "tick_cue", [])[1] == [[1, 1]]
        world_tick = session.world.master.tick
        told = answer(second, session, "tick_cue", [])[1]
        master = session.world.master
        assert [(one.kind, one.follower) for one in master.events] == [("own_tick", "second")]
        assert master.followers == ()
        assert "second ticks, but first has ticked first" in caplog.text
        if other_ticks == "obey":
            assert (told, session.frame) == ([[1, 2]], 2)
            assert master.tick > world_tick
        elif other_ticks == "follow":
            assert (told, session.frame, master.tick) == ([[1, 2]], 1, world_tick)
        else:
            assert told[0][0] == 0
            assert "second ticks, but first is the time master: wait for its ticks" in told[0][1][0]
            assert (session.frame, master.tick) == (1, world_tick)
        answer(first, session, "tick_cue", [])
        assert master.own_ticks == 1
        session.release(first)
        answer(second, session, "tick_cue", [])  # the second client is the master now
        assert master.own_ticks == 1


def test_a_step_shorter_than_that_of_the_world_restarts_the_world(
    session: CarlaSession, call: Call
) -> None:
    rest = [True, 0.01, 10, 0.0, True, 3000.0, 2000.0, True]
    episode, lights = session.episode, session.actors.lights["id"].tolist()
    call("set_episode_settings", [True, False, [True, 0.02], *rest])
    assert session.world.step_s == pytest.approx(0.02)
    assert session.episode == episode
    assert session.actors.lights["id"].tolist() == lights
    session.tick()
    assert session.world.master.dt_s == pytest.approx(0.02)
    call("set_episode_settings", [False, False, [False], *rest])


def test_a_map_is_loaded_by_its_name(session: CarlaSession, call: Call) -> None:
    episode = session.episode
    with pytest.raises(RuntimeError, match="Map 'Town01' not found"):
        call("load_new_episode", "Town01", True, 0)
    assert session.episode == episode
    call("load_new_episode", "/Game/Carla/Maps/intersection", True, 0)
    assert (session.episode, session.map.path) == (episode + 1, "Carla/Maps/intersection")
    call("load_new_episode", "", True, 0)
    assert session.map.path == "Carla/Maps/intersection"
    call("load_new_episode", "grid4x4", True, 0)
    assert len(session.world.env.agents) == 3  # the map with which the server was started
    assert not {"cities", "cities_validation"} & {
        name.rpartition("/")[2] for name in call("get_available_maps")
    }


def test_the_server_lists_traffic_managers(call: Call) -> None:
    assert call("get_traffic_manager_running", 8000) == ["", 0]
    assert call("add_traffic_manager_running", ["10.0.0.1", 8000])
    assert not call("add_traffic_manager_running", ["10.0.0.2", 8000])
    assert call("get_traffic_manager_running", 8000) == ["10.0.0.1", 8000]
    assert call("destroy_traffic_manager", 8000)
    assert not call("is_traffic_manager_running", 8000)
