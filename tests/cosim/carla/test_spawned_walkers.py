"""Walkers that CARLA's clients spawn into a world."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest

from cavmarl.core.records.codes import CLASS_PEDESTRIAN
from cavmarl.cosim.carla.navigation_mesh import mesh_shapes
from tests.cosim.carla.conftest import Call, CarlaSession, run_client, running_server
from tests.cosim.carla.test_official_client import FREE, SYNCHRONOUS

WALKER = [0, "walker.pedestrian.0001", []]


def test_a_walker_walks_in_the_direction_of_its_control(session: CarlaSession, call: Call) -> None:
    number = call("spawn_actor", WALKER, [[30.0, -7.0, 1.0], [0.0, 90.0, 0.0]])[0]
    session.tick()
    actor = session.actors.actors[number]
    row = session.world.rows[session.world.rows["id"] == actor.vehicle][0]
    types = session.world.simulation.types
    assert types["vclass"][row["vtype"]] == CLASS_PEDESTRIAN
    start = session.actors.pose_of(actor)
    assert (start.x, start.y, start.yaw) == pytest.approx((30.0, -7.0, 90.0), abs=1e-3)
    assert start.z == pytest.approx(0.93, abs=0.01)
    call("apply_control_to_walker", number, [[1.0, 0.0, 0.0], 1.5, False])
    for _ in range(20):
        session.tick()
    there = session.actors.pose_of(actor)
    assert (there.x - start.x, there.y - start.y) == pytest.approx((1.5, 0.0), abs=0.01)
    assert there.yaw == pytest.approx(0.0, abs=0.01)
    assert there.z == pytest.approx(start.z, abs=0.01)
    call("apply_control_to_walker", number, [[0.0, 0.0, 0.0], 0.0, False])
    session.tick()
    session.tick()
    state = session.actors.state_of(actor)
    assert state is not None
    assert math.hypot(*state["velocity"][:2].tolist()) == 0.0
    with pytest.raises(RuntimeError, match="is not a vehicle"):
        call("apply_control_to_vehicle", number, [1.0, 0.0, 0.0, False, False, False, 0])
    with pytest.raises(RuntimeError, match="is not a walker"):
        call("set_walker_state", 1, [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]], 1.0)
    assert call("destroy_actor", number)
    session.tick()
    assert number not in session.actors.actors


def test_a_walker_stops_at_the_edge_of_the_map(session: CarlaSession, call: Call) -> None:
    east = session.map.network.extent_m[2] + 99.0
    number = call("spawn_actor", WALKER, [[east, 0.0, 1.0], [0.0, 0.0, 0.0]])[0]
    call("apply_control_to_walker", number, [[1.0, 0.0, 0.0], 5.0, False])
    for _ in range(20):
        session.tick()
    place = session.actors.pose_of(session.actors.actors[number]).x
    assert east < place < east + 1.1
    call("destroy_actor", number)
    session.tick()


def test_the_official_client_uses_walkers() -> None:
    with running_server(agents=1, background=0) as port:
        found = run_client(
            port,
            SYNCHRONOUS
            + """
library = world.get_blueprint_library()
kinds = sorted(library.filter("walker.pedestrian.*"), key=lambda one: one.id)
start = world.get_map().get_spawn_points()[10]
beside = start.location + 5.0 * start.get_right_vector()
Spawn, Control = carla.command.SpawnActor, carla.command.ApplyWalkerControl
Future, State = carla.command.FutureActor, carla.command.ApplyWalkerState
Transform = carla.Transform
walks = carla.WalkerControl(-1.0 * start.get_right_vector(), 2.0, False)
batch = [Spawn(kinds[0], Transform(beside, start.rotation)).then(Control(Future, walks))]
batch += [Spawn(kinds[1], Transform(beside + 3.0 * start.get_forward_vector()))]
answers = client.apply_batch_sync(batch, True)
found["errors"] = [one.error for one in answers]
first, second = world.get_actors([one.actor_id for one in answers])
found["type"] = first.type_id
for _ in range(20):
    world.tick()
found["walked"] = first.get_location().distance(beside)
found["control"] = first.get_control().speed
found["speed"] = first.get_velocity().length()
found["box"] = [first.bounding_box.extent.z, first.bounding_box.location.z]
there = second.get_transform()
there.location.x += 0.1
ground = carla.Transform(there.location - carla.Location(z=0.93), there.rotation)
client.apply_batch_sync([State(second.id, ground, 2.0)], True)
found["state"] = second.get_location().distance(there.location)
camera = library.find("sensor.camera.semantic_segmentation")
camera.set_attribute("image_size_x", "160")
camera.set_attribute("image_size_y", "90")
eye = carla.Transform(beside + 6.0 * start.get_forward_vector() + carla.Location(z=1.0))
eye.rotation.yaw = start.rotation.yaw + 180.0
camera = world.spawn_actor(camera, eye)
images = queue.Queue()
camera.listen(images.put)
import time
time.sleep(0.5)
world.tick()
image = images.get(timeout=10.0)
found["pedestrians"] = sum(1 for tag in bytes(image.raw_data)[2::4] if tag == 12)
found["number"] = len(world.get_actors().filter("walker.*"))
client.apply_batch_sync([carla.command.DestroyActor(one) for one in (first, second)], True)
world.tick()
found["left"] = len(world.get_actors().filter("walker.*"))
"""
            + FREE,
        )
    assert found["errors"] == ["", ""]
    assert found["type"] == "walker.pedestrian.0001"
    assert found["walked"] == pytest.approx(2.0, abs=0.2)
    assert found["control"] == pytest.approx(2.0, abs=0.01)
    assert found["speed"] == pytest.approx(2.0, abs=0.01)
    assert found["box"] == pytest.approx([0.93, 0.0])
    assert found["state"] == pytest.approx(0.0, abs=0.02)
    assert found["pedestrians"] > 50
    assert (found["number"], found["left"]) == (2, 0)


def test_vehicles_stop_for_a_walker_on_the_road() -> None:
    with running_server(agents=1, background=0) as port:
        found = run_client(
            port,
            SYNCHRONOUS
            + """
car = next(one for one in world.get_actors().filter("vehicle.*"))
ahead = world.get_map().get_waypoint(car.get_location()).next(25.0)[0].transform
ahead.location.z += 1.0
blueprint = world.get_blueprint_library().find("walker.pedestrian.0002")
walker = world.try_spawn_actor(blueprint, ahead)
found["spawned"] = walker is not None
nearest = []
for _ in range(200):
    world.tick()
    nearest.append(car.get_location().distance(walker.get_location()))
found["nearest"] = min(nearest)
found["speed"] = car.get_velocity().length()
"""
            + FREE,
        )
    assert found["spawned"]
    assert found["nearest"] > 2.7


def test_walkers_of_the_client_walk_on_the_navigation_mesh() -> None:
    with running_server(agents=1, background=0) as port:
        found = run_client(
            port,
            SYNCHRONOUS
            + """
library = world.get_blueprint_library()
world.set_pedestrians_seed(7)
world.set_pedestrians_cross_factor(1.0)
kinds = sorted(library.filter("walker.pedestrian.*"), key=lambda one: one.id)
places = [world.get_random_location_from_navigation() for _ in range(8)]
road_map = world.get_map()
def off_road(place):
    there = road_map.get_waypoint(place)
    return there.transform.location.distance(carla.Location(place.x, place.y, 0.0))
found["beside"] = [off_road(one) for one in places]
Spawn = carla.command.SpawnActor
def raised(place):
    return carla.Transform(place + carla.Location(z=1.0))
batch = [Spawn(kinds[k % len(kinds)], raised(place)) for k, place in enumerate(places)]
walkers = [one.actor_id for one in client.apply_batch_sync(batch, True) if not one.error]
control = library.find("controller.ai.walker")
batch = [Spawn(control, carla.Transform(), one) for one in walkers]
answers = client.apply_batch_sync(batch, True)
found["errors"] = [one.error for one in answers if one.error]
controls = world.get_actors([one.actor_id for one in answers])
world.tick()
for one in controls:
    one.start()
    one.go_to_location(world.get_random_location_from_navigation())
    one.set_max_speed(1.6)
actors = world.get_actors(walkers)
starts = [one.get_location() for one in actors]
beside, speeds = [], []
for _ in range(200):
    world.tick()
    beside += [off_road(one.get_location()) for one in actors]
    speeds += [one.get_velocity().length() for one in actors]
found["moved"] = [one.get_location().distance(start) for one, start in zip(actors, starts)]
found["heights"] = [one.get_location().z for one in actors]
found["fastest"] = max(speeds)
for one in controls:
    one.stop()
batch = [carla.command.DestroyActor(one) for one in (*controls, *walkers)]
client.apply_batch_sync(batch, True)
world.tick()
found["left"] = len(world.get_actors().filter("walker.*"))
"""
            + FREE,
        )
    assert all(1.5 < away < 5.0 for away in found["beside"])
    assert found["errors"] == []
    assert len(found["moved"]) == 8
    assert sum(moved > 4.0 for moved in found["moved"]) >= 4
    assert found["heights"] == pytest.approx([0.93] * 8, abs=0.3)
    assert 1.0 < found["fastest"] < 3.0
    assert found["left"] == 0


def test_the_mesh_covers_every_road_and_is_one_file(session: CarlaSession, call: Call) -> None:
    (name,) = call("get_required_files", "Nav")
    assert call("get_required_files", "TM") == []
    content = call("request_file", name)
    assert content == call("get_navigation_mesh")
    assert name.startswith("Cavmarl/grid4x4-")
    with pytest.raises(RuntimeError, match="this server has no file '/etc/passwd'"):
        call("request_file", "/etc/passwd")
    head = struct.unpack_from("<7i", content, 12 + 28 + 8)
    roads = np.count_nonzero(~session.map.network.edges["internal"])
    assert head[:2] == (int.from_bytes(b"DNAV", "big"), 7)
    assert head[6] > 10 * roads


def test_the_mesh_is_connected_around_each_block(session: CarlaSession) -> None:
    vertices, shapes, areas = mesh_shapes(session.map.network)
    corners = vertices[shapes][:, :, [0, 2]].astype(np.float64)
    area_m2 = 0.5 * np.sum(
        np.roll(corners[..., 0], -1, axis=1) * corners[..., 1]
        - corners[..., 0] * np.roll(corners[..., 1], -1, axis=1),
        axis=1,
    )
    assert (area_m2 > 0.0).all()
    sides: dict[tuple[int, int], int] = {}
    for shape in shapes.tolist():
        for one, other in zip(shape, shape[1:] + shape[:1], strict=True):
            sides[one, other] = sides.get((one, other), 0) + 1
    assert set(sides.values()) == {1}
    assert sum((other, one) in sides for one, other in sides) > 2 * len(shapes) - 400
    assert np.count_nonzero(areas[:, 0] == 2) == 64
