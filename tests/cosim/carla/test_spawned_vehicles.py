"""Vehicles that CARLA's clients spawn into a world."""

from __future__ import annotations

import pytest

from tests.cosim.carla.conftest import Call, CarlaSession, run_client, running_server
from tests.cosim.carla.test_official_client import FREE, SYNCHRONOUS

FIND_FREE = """
library = world.get_blueprint_library()
taken = [one.get_location() for one in world.get_actors().filter("vehicle.*")]
points = [
    one for one in world.get_map().get_spawn_points()
    if min(one.location.distance(other) for other in taken) > 25.0
]
"""


def test_a_client_spawns_drives_and_destroys_a_vehicle() -> None:
    with running_server(agents=2, background=6) as port:
        found = run_client(
            port,
            SYNCHRONOUS
            + FIND_FREE
            + """
start = points[0]
car = world.spawn_actor(library.find("vehicle.tesla.model3"), start)
found["occupied"] = world.try_spawn_actor(library.find("vehicle.audi.tt"), start) is None
world.tick()
found["entered"] = car.get_location().distance(start.location)
found["again"] = world.try_spawn_actor(library.find("vehicle.audi.tt"), start) is None
found["kinds"] = [car.type_id, car.attributes["role_name"], round(car.bounding_box.extent.x, 3)]
car.apply_control(carla.VehicleControl(throttle=0.8))
for _ in range(60):
    world.tick()
found["driven"] = car.get_location().distance(start.location)
found["speed"] = car.get_velocity().length()
found["throttle"] = round(car.get_control().throttle, 3)
car.apply_control(carla.VehicleControl(brake=1.0))
for _ in range(60):
    world.tick()
found["stopped"] = car.get_velocity().length()
found["number"] = len(world.get_actors().filter("vehicle.*"))
found["destroyed"] = car.destroy()
world.tick()
world.tick()
found["left"] = len(world.get_actors().filter("vehicle.*"))
"""
            + FREE,
        )
    assert found["occupied"]
    assert found["again"]
    assert found["destroyed"]
    assert found["entered"] == pytest.approx(0.0, abs=0.5)
    assert found["kinds"] == ["vehicle.tesla.model3", "autopilot", 2.395]
    assert found["driven"] > 10.0
    assert found["speed"] > 5.0
    assert found["throttle"] == 0.8
    assert found["stopped"] == pytest.approx(0.0, abs=0.05)
    assert found["number"] == found["left"] + 1


def test_a_client_sets_the_pose_of_its_vehicle() -> None:
    with running_server(agents=2, background=0) as port:
        found = run_client(
            port,
            SYNCHRONOUS
            + FIND_FREE
            + """
start, other = points[0], points[-1]
car = world.spawn_actor(library.find("vehicle.audi.a2"), start)
car.set_simulate_physics(False)
world.tick()
ahead = start.get_forward_vector()
for step in range(1, 21):
    there = carla.Transform(start.location + 0.5 * step * ahead, start.rotation)
    car.set_transform(there)
    world.tick()
found["moved"] = car.get_location().distance(there.location)
found["speed"] = car.get_velocity().length()
number = car.id
car.set_transform(other)
world.tick()
world.tick()
found["jumped"] = car.get_location().distance(other.location)
found["same"] = [car.id == number, len(world.get_actors([number]))]
car.apply_control(carla.VehicleControl(throttle=0.5))
world.tick()
car.set_transform(start)
world.tick()
found["back"] = car.get_location().distance(start.location)
world.tick()
world.tick()
found["onward"] = car.get_location().distance(start.location)
"""
            + FREE,
        )
    assert found["moved"] == pytest.approx(0.0, abs=0.05)
    assert found["speed"] == pytest.approx(10.0, abs=0.5)
    assert found["jumped"] < 1.0
    assert found["same"] == [True, 1]
    assert found["back"] < 0.5
    assert found["onward"] > found["back"], "the vehicle does not use its last control"


def test_the_traffic_manager_drives_spawned_vehicles() -> None:
    with running_server(agents=1, background=0) as port:
        found = run_client(
            port,
            SYNCHRONOUS
            + FIND_FREE
            + """
manager = client.get_trafficmanager(8123)
manager.set_synchronous_mode(True)
Spawn, Auto, Future = (
    carla.command.SpawnActor, carla.command.SetAutopilot, carla.command.FutureActor
)
blueprint = library.find("vehicle.lincoln.mkz_2020")
batch = [Spawn(blueprint, one).then(Auto(Future, True, 8123)) for one in points[:40:10]]
answers = client.apply_batch_sync(batch, True)
found["errors"] = [one.error for one in answers]
ids = [one.actor_id for one in answers]
starts = [one.location for one in points[:40:10]]
for _ in range(200):
    world.tick()
present = {one.id: one for one in world.get_actors() if one.id in ids}  # dead ends destroy
cars = list(present.values())
starts = [start for one, start in zip(ids, starts) if one in present]
found["moved"] = [a.get_location().distance(b) for a, b in zip(cars, starts)]
road_map = world.get_map()
found["aside"] = max(
    road_map.get_waypoint(one.get_location()).transform.location.distance(one.get_location())
    for one in cars
)
client.apply_batch_sync([Auto(one, False, 8123) for one in present], True)
client.apply_batch_sync([carla.command.DestroyActor(one) for one in present], True)
world.tick()
found["left"] = len(world.get_actors(ids))
manager.set_synchronous_mode(False)
"""
            + FREE,
        )
    assert found["errors"] == ["", "", "", ""]
    assert len(found["moved"]) >= 2
    assert min(found["moved"]) > 5.0
    assert found["aside"] < 3.0


def test_a_client_drives_backward_and_stops() -> None:
    with running_server(agents=1, background=0) as port:
        found = run_client(
            port,
            SYNCHRONOUS
            + FIND_FREE
            + """
start = points[0]
car = world.spawn_actor(library.find("vehicle.tesla.model3"), start)
world.tick()
ahead = start.get_forward_vector()
def along():
    moved = car.get_location() - start.location
    return moved.x * ahead.x + moved.y * ahead.y
car.apply_control(carla.VehicleControl(throttle=0.6))
for _ in range(20):
    world.tick()
found["forward"] = along()
car.apply_control(carla.VehicleControl(throttle=0.6, reverse=True))
for _ in range(60):
    world.tick()
found["backward"] = along()
found["control"] = [car.get_control().reverse, car.get_control().gear]
velocity = car.get_velocity()
found["speed"] = velocity.x * ahead.x + velocity.y * ahead.y
car.apply_control(carla.VehicleControl(throttle=0.4, reverse=True, steer=0.4))
before = car.get_transform().rotation.yaw
for _ in range(20):
    world.tick()
found["turned"] = (car.get_transform().rotation.yaw - before + 180.0) % 360.0 - 180.0
car.apply_control(carla.VehicleControl(brake=1.0))
for _ in range(40):
    world.tick()
found["stopped"] = car.get_velocity().length()
"""
            + FREE,
        )
    assert found["forward"] > 0.5
    assert found["backward"] < found["forward"] - 2.0
    assert found["control"] == [True, -1]
    assert found["speed"] < -2.0
    assert found["turned"] < -2.0, "a car that drives backward and steers right does not turn left"
    assert found["stopped"] == pytest.approx(0.0, abs=0.02)


def test_a_client_sets_velocities_and_impulses() -> None:
    with running_server(agents=1, background=0) as port:
        found = run_client(
            port,
            SYNCHRONOUS
            + FIND_FREE
            + """
start = points[0]
car = world.spawn_actor(library.find("vehicle.tesla.model3"), start)
world.tick()
ahead = start.get_forward_vector()
car.set_target_velocity(8.0 * ahead)
world.tick()
found["set"] = car.get_velocity().length()
for _ in range(20):
    world.tick()
found["rolls"] = car.get_velocity().length()
car.enable_constant_velocity(carla.Vector3D(5.0, 0.0, 0.0))
before = car.get_location()
for _ in range(20):
    world.tick()
found["constant"] = [car.get_velocity().length(), car.get_location().distance(before)]
car.disable_constant_velocity()
car.apply_control(carla.VehicleControl(brake=1.0))
for _ in range(40):
    world.tick()
found["stopped"] = car.get_velocity().length()
car.apply_control(carla.VehicleControl())
car.add_impulse(3.0 * 1845.0 * ahead)
world.tick()
found["pushed"] = car.get_velocity().length()
yaw = car.get_transform().rotation.yaw
car.set_target_angular_velocity(carla.Vector3D(0.0, 0.0, 40.0))
world.tick()
found["turned"] = (car.get_transform().rotation.yaw - yaw + 180.0) % 360.0 - 180.0
"""
            + FREE,
        )
    assert found["set"] == pytest.approx(8.0, abs=0.1)
    assert 6.0 < found["rolls"] < 8.0
    assert found["constant"] == pytest.approx([5.0, 5.0], abs=0.05)
    assert found["stopped"] == pytest.approx(0.0, abs=0.02)
    assert found["pushed"] == pytest.approx(3.0, abs=0.3)
    assert found["turned"] == pytest.approx(2.0, abs=0.1)


def test_bad_spawns_are_refused(call: Call, session: CarlaSession) -> None:
    what = [0, "vehicle.tesla.model3", []]
    turned = [0.0, 0.0, 0.0]
    with pytest.raises(RuntimeError, match="outside of the map"):
        call("spawn_actor", what, [[1e6, 0.0, 0.0], turned])
    with pytest.raises(RuntimeError, match="not a finite number"):
        call("spawn_actor", what, [[float("nan"), 0.0, 0.0], turned])
    with pytest.raises(RuntimeError, match="actor definition not found"):
        call("spawn_actor", [0, "walker.pedestrian.9999", []], [[0.0, 0.0, 0.0], turned])
    room = session.world.env.config.population.external
    poses = [
        [[8.0 * (place % 10) - 60.0, 8.0 * (place // 10) + 40.0, 0.0], turned]
        for place in range(room + 1)
    ]
    made = [call("spawn_actor", what, pose)[0] for pose in poses[:room]]
    with pytest.raises(RuntimeError, match=r"population\.external"):
        call("spawn_actor", what, poses[room])
    session.tick()
    for number in made:
        assert call("destroy_actor", number)
    session.tick()
    assert not any(number in session.actors.actors for number in made)


def test_spawned_actors_outlive_a_change_of_the_step() -> None:
    """CARLA's examples spawn first, and then choose a step that restarts the world."""
    with running_server(agents=2, background=2) as port:
        found = run_client(
            port,
            FIND_FREE
            + """
start = points[0]
car = world.spawn_actor(library.find("vehicle.tesla.model3"), start)
gnss = world.spawn_actor(library.find("sensor.other.gnss"), carla.Transform(), attach_to=car)
lights = [one.id for one in world.get_actors().filter("traffic.traffic_light")]
fixes = queue.Queue()
settings = world.get_settings()
settings.synchronous_mode, settings.fixed_delta_seconds = True, 1.0 / 30.0
world.apply_settings(settings)
gnss.listen(fixes.put)
frame = world.tick()
found["late"] = fixes.get(timeout=10.0).frame - frame
found["moved"] = car.get_location().distance(start.location)
found["lights"] = lights == [one.id for one in world.get_actors().filter("traffic.traffic_light")]
car.apply_control(carla.VehicleControl(throttle=0.8))
for _ in range(45):
    world.tick()
before = car.get_location()
found["speed"] = car.get_velocity().length()
settings.fixed_delta_seconds = 0.02
world.apply_settings(settings)
frame = world.tick()
while fixes.get(timeout=10.0).frame < frame:
    pass
found["kept"] = [car.get_velocity().length(), car.get_location().distance(before)]
found["throttle"] = car.get_control().throttle
gnss.stop()
found["destroyed"] = [gnss.destroy(), car.destroy()]
"""
            + FREE,
        )
    assert found["late"] == 0
    assert found["moved"] < 0.5
    assert found["lights"]
    assert found["speed"] > 3.0
    assert found["kept"][0] >= found["speed"]
    assert 0.0 < found["kept"][1] < 2.0
    assert found["throttle"] == pytest.approx(0.8)
    assert found["destroyed"] == [True, True]


def test_a_tick_waits_for_the_listener_of_a_new_sensor() -> None:
    with running_server(agents=1, background=0) as port:
        found = run_client(
            port,
            SYNCHRONOUS
            + """
blueprint = world.get_blueprint_library().find("sensor.other.imu")
vehicle = next(iter(world.get_actors().filter("vehicle.*")))
late = []
for _ in range(20):
    sensor = world.spawn_actor(blueprint, carla.Transform(), attach_to=vehicle)
    frames = queue.Queue()
    sensor.listen(frames.put)
    frame = world.tick()
    late.append(frames.get(timeout=10.0).frame - frame)
    sensor.stop()
    sensor.destroy()
found["late"] = late
"""
            + FREE,
        )
    assert found["late"] == [0] * 20
