"""CARLA's official client uses a world: its map, time, actors, sensors and traffic manager."""

from __future__ import annotations

import pytest

from cavmarl.cosim.carla.carla_blueprints import BLUEPRINTS
from tests.cosim.carla.conftest import run_client, running_server

SYNCHRONOUS = """
settings = world.get_settings()
settings.synchronous_mode, settings.fixed_delta_seconds = True, 0.05
world.apply_settings(settings)
world.tick()
"""
FREE = """
settings.synchronous_mode, settings.fixed_delta_seconds = False, None
world.apply_settings(settings)
"""


def test_it_connects_and_waits_for_ticks(port: int) -> None:
    found = run_client(
        port,
        """
seen = []
callback = world.on_tick(lambda snapshot: seen.append(snapshot.frame))
first = world.wait_for_tick()
second = world.wait_for_tick()
found["frames"] = [first.frame, second.frame]
found["delta"] = second.timestamp.delta_seconds
found["elapsed"] = second.timestamp.elapsed_seconds - first.timestamp.elapsed_seconds
found["seen"] = second.frame in seen or world.wait_for_tick() is not None
world.remove_on_tick(callback)
found["versions"] = [client.get_client_version(), client.get_server_version()]
found["maps"] = client.get_available_maps()
world.set_weather(carla.WeatherParameters.ClearNoon)
found["sun"] = world.get_weather().sun_altitude_angle
world.debug.draw_point(carla.Location(1, 2, 3))
spectator = world.get_spectator()
spectator.set_transform(carla.Transform(carla.Location(10, 20, 30), carla.Rotation(-90)))
world.wait_for_tick()
world.wait_for_tick()
found["spectator"] = spectator.get_location().z
""",
    )
    first, second = found["frames"]
    assert second > first
    assert found["delta"] == pytest.approx(0.05)
    assert found["elapsed"] == pytest.approx(0.05 * (second - first))
    assert found["seen"]
    assert found["versions"] == ["0.9.16", "0.9.16"]
    assert "/Game/Carla/Maps/grid4x4" in found["maps"]
    assert found["sun"] == 45.0
    assert found["spectator"] == pytest.approx(30.0)


def test_its_map_is_the_map_of_the_world(port: int) -> None:
    found = run_client(
        port,
        SYNCHRONOUS
        + """
road_map = world.get_map()
found["name"] = road_map.name
away, turned = [], []
for pose in road_map.get_spawn_points():
    there = road_map.get_waypoint(pose.location).transform
    away.append(there.location.distance(pose.location))
    turned.append(abs((there.rotation.yaw - pose.rotation.yaw + 180.0) % 360.0 - 180.0))
found["away"], found["turned"], found["points"] = max(away), max(turned), len(away)
marks = road_map.get_all_landmarks_of_type("1000001")
lights = [world.get_traffic_light(mark) for mark in marks]
found["lights"] = [len(marks), sum(light is not None for light in lights)]
found["in_junction"] = sorted({
    len(world.get_traffic_lights_in_junction(light.get_affected_lane_waypoints()[0]
        .next_until_lane_end(1.0)[-1].next(3.0)[0].junction_id) or [])
    for light in lights[:8] if light.get_affected_lane_waypoints()
})
lines = [point.transform for light in lights for point in light.get_stop_waypoints()]
found["stop_lines"] = len(lines)
place = carla.Location(100.0, -200.0, 1.0)
geo = road_map.transform_to_geolocation(place)
found["geo"] = [geo.latitude, geo.longitude]
vehicles = world.get_actors().filter("vehicle.*")
found["off_lane"] = max(
    road_map.get_waypoint(one.get_location()).transform.location.distance(one.get_location())
    for one in vehicles
)
"""
        + FREE,
    )
    assert found["name"] == "Carla/Maps/grid4x4"
    assert found["points"] == 320
    assert found["away"] == pytest.approx(0.3, abs=0.3)
    assert found["turned"] < 1.0
    assert found["lights"] == [64, 64]
    assert found["in_junction"] == [4]
    assert found["stop_lines"] >= 64
    assert found["off_lane"] < 2.0


def test_the_place_on_the_earth_is_that_of_the_gnss(port: int) -> None:
    found = run_client(
        port,
        SYNCHRONOUS
        + """
vehicle = next(iter(world.get_actors().filter("vehicle.*")))
blueprint = world.get_blueprint_library().find("sensor.other.gnss")
gnss = world.spawn_actor(blueprint, carla.Transform(carla.Location(z=2.0)), attach_to=vehicle)
frames = queue.Queue()
gnss.listen(frames.put)
import time
time.sleep(0.5)
frame = world.tick()
measured = frames.get(timeout=10.0)
while measured.frame < frame:
    measured = frames.get(timeout=10.0)
place = world.get_map().transform_to_geolocation(measured.transform.location)
found["frame"] = measured.frame - frame
found["apart"] = [measured.latitude - place.latitude, measured.longitude - place.longitude]
gnss.stop()
found["destroyed"] = gnss.destroy()
"""
        + FREE,
    )
    assert found["frame"] == 0
    assert found["apart"] == pytest.approx([0.0, 0.0], abs=1e-8)
    assert found["destroyed"]


def test_the_clients_traffic_manager_drives_the_agents(port: int) -> None:
    found = run_client(
        port,
        SYNCHRONOUS
        + """
road_map = world.get_map()
manager = client.get_trafficmanager(8123)
manager.set_synchronous_mode(True)
agents = [one for one in world.get_actors().filter("vehicle.*")
          if one.attributes["role_name"].startswith("car_")]
for one in agents:
    one.set_autopilot(True, 8123)
away, moved, before = [], 0.0, {one.id: one.get_location() for one in agents}
for step in range(400):
    world.tick()
    for one in agents:
        here = one.get_location()
        if not one.is_alive or (here.x == 0.0 and here.y == 0.0):
            continue
        moved += here.distance(before[one.id])
        before[one.id] = here
        away.append(road_map.get_waypoint(here).transform.location.distance(here))
found["agents"], found["moved"] = len(agents), moved
away.sort()
found["away"] = away[int(0.95 * len(away))]
for one in agents:
    one.set_autopilot(False, 8123)
manager.set_synchronous_mode(False)
"""
        + FREE,
    )
    assert found["agents"] == 3
    assert found["moved"] > 100.0
    assert found["away"] < 1.0


def test_a_program_drives_an_agent(port: int) -> None:
    found = run_client(
        port,
        SYNCHRONOUS
        + """
agent = next(one for one in world.get_actors().filter("vehicle.*")
             if one.attributes["role_name"] == "car_1")
for step in range(80):
    agent.apply_control(carla.VehicleControl(brake=1.0))
    world.tick()
found["stopped"] = agent.get_velocity().length()
found["brake"] = agent.get_control().brake
start = agent.get_location()
for step in range(20):
    agent.apply_control(carla.VehicleControl(throttle=1.0))
    world.tick()
found["speed"] = agent.get_velocity().length()
found["moved"] = agent.get_location().distance(start)
found["box"] = [agent.bounding_box.extent.x, agent.bounding_box.extent.y]
try:
    agent.destroy()
except RuntimeError as error:
    found["destroy"] = str(error)
else:
    found["destroy"] = ""
vehicle = world.get_blueprint_library().find("vehicle.tesla.model3")
try:
    world.spawn_actor(vehicle, world.get_map().get_spawn_points()[0])
except RuntimeError as error:
    found["spawn"] = str(error)
found["try_spawn"] = world.try_spawn_actor(vehicle, world.get_map().get_spawn_points()[0]) is None
"""
        + FREE,
    )
    assert found["stopped"] < 0.01
    assert found["brake"] == 1.0
    assert found["speed"] == pytest.approx(4.2, abs=0.3)
    assert found["moved"] == pytest.approx(0.5 * 4.2, abs=0.4)
    assert found["box"] == [2.5, 1.0]
    assert "no room: population.external is 0" in found["spawn"]
    assert found["try_spawn"]


def test_maps_are_loaded_and_generated(port: int) -> None:
    found = run_client(
        port,
        """
text = world.get_map().to_opendrive()
first = world.id
other = client.load_world("intersection")
found["other"] = [other.get_map().name, other.id != first]
other.wait_for_tick()
found["actors"] = len(other.get_actors().filter("vehicle.*"))
again = client.reload_world()
found["again"] = [again.get_map().name, again.id != other.id]
try:
    client.load_world("Town01")
except RuntimeError as error:
    found["unknown"] = str(error)
made = client.generate_opendrive_world(text, carla.OpendriveGenerationParameters())
found["made"] = [made.get_map().name, len(made.get_map().get_spawn_points()) > 100]
try:
    client.generate_opendrive_world("<nothing/>", carla.OpendriveGenerationParameters())
except RuntimeError as error:
    found["garbage"] = str(error)
back = client.load_world("grid4x4")
found["back"] = back.get_map().name
""",
    )
    assert found["other"] == ["Carla/Maps/intersection", True]
    assert found["actors"] > 0
    assert found["again"] == ["Carla/Maps/intersection", True]
    assert "Map 'Town01' not found" in found["unknown"]
    assert found["made"] == ["Carla/Maps/OpenDriveMap", True]
    assert found["garbage"]
    assert found["back"] == "Carla/Maps/grid4x4"


def test_two_clients_share_the_world(port: int) -> None:
    found = run_client(
        port,
        SYNCHRONOUS
        + """
other = carla.Client("127.0.0.1", int(sys.argv[1]))
other.set_timeout(20.0)
shared = other.get_world()
found["synchronous"] = shared.get_settings().synchronous_mode
frames = [world.tick(), shared.tick(), world.tick()]
found["frames"] = [frames[1] - frames[0], frames[2] - frames[1]]
"""
        + FREE,
    )
    assert found["synchronous"]
    assert found["frames"] == [1, 1]


@pytest.mark.parametrize("version", ["0.9.15", "0.10.0"])
def test_other_versions_of_the_client_use_the_world(version: str) -> None:
    program = (
        SYNCHRONOUS
        + """
agent = next(one for one in world.get_actors().filter("vehicle.*")
             if one.attributes["role_name"] == "car_1")
library = world.get_blueprint_library()
found["blueprints"] = len(library)
found["colour"] = library.find("vehicle.tesla.model3").get_attribute("color").recommended_values[0]
camera = library.find("sensor.camera.rgb")
camera.set_attribute("image_size_x", "32")
camera.set_attribute("image_size_y", "16")
where = carla.Transform(carla.Location(x=1.0, z=1.5))
mounted = world.spawn_actor(camera, where, attach_to=agent)
frames = queue.Queue()
mounted.listen(frames.put)
batch = carla.command.SpawnActor(library.find("sensor.other.imu"), where, agent)
answer = client.apply_batch_sync([batch, carla.command.DestroyActor(10**6)], False)
found["batch"] = [bool(one.error) for one in answer]
import time
time.sleep(0.5)
for step in range(80):
    agent.apply_control(carla.VehicleControl(brake=1.0))
    frame = world.tick()
picture = frames.get(timeout=10.0)
found["picture"] = [picture.width, picture.height]
found["speed"] = agent.get_velocity().length()
found["box"] = agent.bounding_box.extent.x
lights = world.get_actors().filter("traffic.traffic_light")
found["lights"] = sorted({str(light.state) for light in lights})
mounted.stop()
mounted.destroy()
"""
        + FREE
    )
    with running_server(client=version) as port:
        found = run_client(port, program, version)
    assert found["blueprints"] == len(BLUEPRINTS)
    assert found["colour"] == "17,37,103"
    assert found["batch"] == [False, True]
    assert found["picture"] == [32, 16]
    assert found["speed"] < 0.01
    assert found["box"] == 2.5
    assert {"Red", "Green"} <= set(found["lights"])
