"""Traffic lights that CARLA's clients set, time, freeze and reset."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from cavmarl import ConfigError, parallel_env
from cavmarl.cosim.carla.carla_map import GREEN, OFF, RED, YELLOW
from cavmarl.cosim.carla.carla_session import CarlaSession
from cavmarl.cosim.carla.traffic_lights import TrafficLights
from tests.cosim.carla.conftest import Call, make_server, run_client, running_server
from tests.cosim.carla.test_official_client import FREE, SYNCHRONOUS


@pytest.fixture
def own_session() -> Iterator[CarlaSession]:
    with make_server() as server:
        yield server.session


def run_ticks(session: CarlaSession, number: int) -> list[list[int]]:
    """Advance `number` ticks; return the states of all lights after each tick."""
    found = []
    for _ in range(number):
        session.tick()
        found.append(session.actors.lights["light_state"].tolist())
    return found


def test_a_light_keeps_a_set_state_for_its_time_and_then_follows_its_group(
    own_session: CarlaSession,
) -> None:
    lights = own_session.world.lights
    run_ticks(own_session, 2)
    before = lights.states().tolist()
    light = before.index(RED)
    lights.set_time(light, GREEN, 1.0)
    lights.set_state(light, GREEN)
    shown = [states[light] for states in run_ticks(own_session, 30)]
    assert shown[:18] == [GREEN] * 18
    assert shown[-5:] == [RED] * 5
    others = [k for k in range(len(before)) if k != light]
    assert [lights.states()[k] for k in others] == [before[k] for k in others]
    lights.set_state(light, OFF)
    assert {states[light] for states in run_ticks(own_session, 40)} == {OFF}


def test_frozen_lights_keep_their_states_and_their_times(own_session: CarlaSession) -> None:
    lights = own_session.world.lights
    plain = [state.copy() for state in run_ticks(own_session, 3)][-1]
    lights.freeze(True)
    frozen = run_ticks(own_session, 1200)  # a minute
    assert {tuple(states) for states in frozen} == {tuple(plain)}
    states = own_session.actors.lights
    assert states["is_frozen"].all()
    elapsed_s = states["elapsed_s"].copy()
    light = plain.index(RED)
    lights.set_state(light, GREEN)
    assert [one[light] for one in run_ticks(own_session, 40)] == [GREEN] * 40
    lights.freeze(False)
    own_session.tick()
    assert not states["is_frozen"].any()
    same = np.arange(len(plain)) != light
    assert states["elapsed_s"][same] == pytest.approx(elapsed_s[same] + 0.05, abs=1e-4)


def test_a_released_group_continues_its_program(own_session: CarlaSession) -> None:
    lights = own_session.world.lights
    with make_server() as other:
        wanted = run_ticks(other.session, 900)
    shown = run_ticks(own_session, 100)
    lights.freeze(True)
    lights.freeze(False)
    assert shown + run_ticks(own_session, 800) == wanted


def test_times_scale_the_cycle_of_a_group(own_session: CarlaSession) -> None:
    lights = own_session.world.lights
    own_session.tick()
    light = lights.states().tolist().index(GREEN)
    lights.reset(light)
    lights.set_time(light, GREEN, 2.0)
    lights.set_time(light, YELLOW, 0.5)
    own_session.tick()
    shown = own_session.actors.lights
    assert shown["times_s"][light].tolist()[:2] == [2.0, 0.5]
    assert shown["times_s"][light][2] == pytest.approx(lights.times_s[light][2])
    states = [one[light] for one in run_ticks(own_session, 60)]
    assert states.count(GREEN) == pytest.approx(39, abs=2)
    assert states.count(YELLOW) == pytest.approx(10, abs=1)
    lights.reset()
    own_session.tick()
    assert (shown["elapsed_s"] <= 0.051).all()
    assert shown["light_state"][light] == GREEN


def test_calls_to_lights_reach_the_world(session: CarlaSession, call: Call) -> None:
    with pytest.raises(RuntimeError, match="actor 1 is not a traffic light"):
        call("set_traffic_light_state", 1, 2)
    light = int(session.actors.lights["id"][0])
    with pytest.raises(RuntimeError, match="state 4 is not Red, Yellow, Green or Off"):
        call("set_traffic_light_state", light, 4)
    with pytest.raises(RuntimeError, match=r"-1 s: must be from 0 to 1e\+06"):
        call("set_traffic_light_green_time", light, -1.0)
    assert call("set_traffic_light_red_time", light, 3.0) is None
    assert call("freeze_traffic_light", light, True) is None
    assert call("freeze_all_traffic_lights", False) is None
    assert call("reset_traffic_light_group", light) is None
    assert call("reset_all_traffic_lights") is None


def test_a_world_without_overrides_refuses_calls_to_lights() -> None:
    env = parallel_env("grid4x4", overrides={"action.kind": "continuous", "signals.overrides": 3})
    env.reset(seed=0)
    with make_server() as server:
        lights = TrafficLights(env, server.session.map)
    with pytest.raises(ConfigError, match=r"signals\.overrides = 3: .* set it to at least 256"):
        lights.freeze(True)


def test_the_official_client_sets_and_freezes_lights() -> None:
    with running_server(agents=2, background=6) as port:
        found = run_client(
            port,
            SYNCHRONOUS
            + """
State = carla.TrafficLightState
lights = list(world.get_actors().filter("traffic.traffic_light"))
light = next(one for one in lights if one.state == State.Red)
found["start"] = str(light.get_state())
light.set_state(State.Green)
light.set_green_time(2.5)
world.tick()
found["green"] = [str(light.state), light.get_green_time()]
for _ in range(60):
    world.tick()
found["later"] = str(light.state)
light.freeze(True)
light.set_state(State.Yellow)
before = [one.state for one in lights if one.id != light.id]
for _ in range(300):
    world.tick()
found["frozen"] = [light.is_frozen(), str(light.state)]
found["others"] = before == [one.state for one in lights if one.id != light.id]
world.freeze_all_traffic_lights(False)
light.set_yellow_time(0.5)
light.set_red_time(7.0)
world.tick()
found["free"] = light.is_frozen()
found["times"] = [light.get_yellow_time(), light.get_red_time()]
group = light.get_group_traffic_lights()
found["group"] = [len(group), light.get_pole_index()]
light.reset_group()
world.tick()
found["elapsed"] = max(one.get_elapsed_time() for one in group)
world.reset_all_traffic_lights()
world.tick()
found["all"] = max(one.get_elapsed_time() for one in lights)
for one in lights:
    one.set_state(State.Off)
world.tick()
found["off"] = sorted({str(one.state) for one in lights})
"""
            + FREE,
        )
    assert found["start"] == "Red"
    assert found["green"] == ["Green", 2.5]
    assert found["later"] == "Red"
    assert found["frozen"] == [True, "Yellow"]
    assert found["others"]
    assert not found["free"]
    assert found["times"] == [0.5, 7.0]
    assert found["group"][0] == 4
    assert found["elapsed"] == pytest.approx(0.0, abs=0.06)
    assert found["all"] == pytest.approx(0.0, abs=0.06)
    assert found["off"] == ["Off"]


def test_a_vehicle_obeys_the_light_that_a_client_sets() -> None:
    with running_server(agents=1, background=0) as port:
        found = run_client(
            port,
            SYNCHRONOUS
            + """
manager = client.get_trafficmanager(8124)
manager.set_synchronous_mode(True)
library = world.get_blueprint_library()
State = carla.TrafficLightState
lights = list(world.get_actors().filter("traffic.traffic_light"))
for one in lights:
    one.set_state(State.Red)
world.freeze_all_traffic_lights(True)
light = lights[5]
before = light.get_stop_waypoints()[0].previous(30.0)[0].transform
before.location.z += 0.3
car = world.spawn_actor(library.find("vehicle.tesla.model3"), before)
world.tick()
car.set_autopilot(True, 8124)
for _ in range(240):
    world.tick()
found["speed"] = car.get_velocity().length()
found["driven"] = car.get_location().distance(before.location)
found["at"] = [car.is_at_traffic_light(), str(car.get_traffic_light_state())]
found["same"] = car.get_traffic_light().id == light.id
light.set_state(State.Green)
for _ in range(120):
    world.tick()
found["onward"] = car.get_location().distance(before.location)
car.set_autopilot(False, 8124)
car.destroy()
manager.set_synchronous_mode(False)
"""
            + FREE,
        )
    assert found["speed"] == pytest.approx(0.0, abs=0.1)
    assert 5.0 < found["driven"] < 32.0
    assert found["at"] == [True, "Red"]
    assert found["same"]
    assert found["onward"] > found["driven"] + 10.0
