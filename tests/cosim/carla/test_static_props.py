"""Static props that CARLA's clients place: traffic stops before them, and sensors see them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from cavmarl.cosim.carla.attached_imaging import SEMANTIC_POINT
from cavmarl.cosim.carla.carla_geometry import CarlaPose
from cavmarl.cosim.carla.carla_session import CarlaSession
from tests.cosim.carla.conftest import Call, make_server, run_client, running_server
from tests.cosim.carla.test_attached_sensors import newest, record_frames
from tests.cosim.carla.test_official_client import SYNCHRONOUS

CONE, BARRIER = "static.prop.trafficcone01", "static.prop.streetbarrier"
PROP_TAG = 21
LIDAR = [
    ["channels", 3, "8"], ["points_per_second", 2, "40000"], ["range", 3, "60"],
    ["upper_fov", 3, "0"], ["lower_fov", 3, "-20"], ["rotation_frequency", 3, "20"],
]  # fmt: skip


def row_of(session: CarlaSession, number: int) -> Any:
    rows = session.world.rows
    return rows[rows["id"] == session.actors.actors[number].vehicle][0]


def test_a_prop_stands_and_can_be_moved_and_destroyed(session: CarlaSession, call: Call) -> None:
    packed = call("spawn_actor", [0, CONE, []], [[60.0, -9.0, 0.0], [0.0, 30.0, 0.0]])
    number = packed[0]
    assert packed[2][1] == CONE
    assert packed[4] == bytes([PROP_TAG])
    for _ in range(10):
        session.tick()
    row = row_of(session, number)
    assert (row["x"], row["y"], row["speed"]) == (60.0, 9.0, 0.0)
    assert row["heading"] == pytest.approx(-math.radians(30.0), abs=1e-6)
    assert (row["length"], row["width"], row["height"]) == pytest.approx((0.4, 0.4, 0.9))
    state = session.actors.state_of(session.actors.actors[number])
    assert state is not None
    assert not state.tobytes()[65:].strip(b"\0"), "a prop accepts controls"
    with pytest.raises(RuntimeError, match="is not a vehicle"):
        call("apply_control_to_vehicle", number, [1.0, 0.0, 0.0, False, False, False, 0])
    call("set_actor_transform", number, [[61.0, -9.0, 0.0], [0.0, 0.0, 0.0]])
    session.tick()
    session.tick()
    assert row_of(session, number)["x"] == 61.0
    with pytest.raises(RuntimeError, match="collision at spawn position"):
        call("spawn_actor", [0, CONE, []], [[61.0, -9.0, 0.0], [0.0, 0.0, 0.0]])
    with pytest.raises(RuntimeError, match="props cannot be attached"):
        call("spawn_actor_with_parent", [0, CONE, []], [[0.0] * 3, [0.0] * 3], number, 0)
    assert call("destroy_actor", number)
    session.tick()
    assert number not in session.actors.actors


def test_sensors_show_the_tag_and_the_number_of_a_prop(
    session: CarlaSession, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = record_frames(monkeypatch)
    number = call("spawn_actor", [0, BARRIER, []], [[66.0, -60.0, 0.0], [0.0, 0.0, 0.0]])[0]
    behind = [[60.0, -60.0, 1.0], [0.0, 0.0, 0.0]]
    lidar = call("spawn_actor", [0, "sensor.lidar.ray_cast_semantic", LIDAR], behind)[0]
    size = [["image_size_x", 2, "160"], ["image_size_y", 2, "90"]]
    semantic, instance = (
        call("spawn_actor", [0, f"sensor.camera.{kind}_segmentation", size], behind)[0]
        for kind in ("semantic", "instance")
    )
    session.tick()
    session.tick()
    actors = session.actors.actors
    bodies = {one: newest(recorder, actors[one]) for one in (lidar, semantic, instance)}
    head = 8 + 4 * 8
    points = np.frombuffer(bodies[lidar][head:], SEMANTIC_POINT)
    hit = points[points["actor"] == number]
    assert len(hit) > 3
    assert (hit["tag"] == PROP_TAG).all()
    assert (points["tag"][points["actor"] != number] != PROP_TAG).all()
    pixels = {
        one: np.frombuffer(bodies[one][12:], np.uint8).reshape(90, 160, 4)
        for one in (semantic, instance)
    }
    shown = pixels[semantic][..., 2] == PROP_TAG
    assert 20 < shown.sum() < 4000
    of_actor = (pixels[instance][..., 1] == number & 255) & (pixels[instance][..., 2] == PROP_TAG)
    assert np.array_equal(of_actor, shown)
    for one in (lidar, semantic, instance, number):
        call("destroy_actor", one)
    session.tick()


def test_traffic_brakes_before_a_prop_and_passes_it() -> None:
    with make_server(agents=1, background=6, env="ring") as server:
        session = server.session
        session.tick()
        network, rows = session.map.network, session.world.rows
        lane, s = int(rows["lane"][-1]), float(rows["s"][-1])
        length_m = float(network.lanes["length_m"][lane])
        x, y, z, heading, *_ = map(float, network.pose_on(lane, (s + 15.0) % length_m))
        there = CarlaPose(x, -y, z, 0.0, -math.degrees(heading), 0.0)
        number = session.spawn(BARRIER, {}, there).number
        slowest_mps = nearest_m = math.inf
        for _ in range(200):
            session.tick()
            rows = session.world.rows[session.world.rows["speed"] > 0.0]
            apart_m = np.hypot(rows["x"] - x, rows["y"] - y)
            nearest_m = min(nearest_m, float(apart_m.min()))
            slowest_mps = min([slowest_mps, *rows["speed"][apart_m < 12.0].tolist()])
        assert slowest_mps < 1.0, "no vehicle brakes before the barrier"
        assert 1.5 < nearest_m < 8.0, "no vehicle passes the barrier on the other lane"
        assert row_of(session, number)["speed"] == 0.0


def test_the_official_client_places_props() -> None:
    with running_server(agents=1, background=0) as port:
        found = run_client(
            port,
            SYNCHRONOUS
            + """
library = world.get_blueprint_library()
props = library.filter("static.prop.*")
found["kinds"] = len(props)
found["sizes"] = sorted({one.get_attribute("size").as_str() for one in props})
start = world.get_map().get_spawn_points()[10]
beside = carla.Transform(start.location + 6.0 * start.get_right_vector(), start.rotation)
cone = world.spawn_actor(library.find("static.prop.constructioncone"), beside)
world.tick()
world.tick()
there = cone.get_transform().location
found["off_m"] = there.distance(carla.Location(beside.location.x, beside.location.y, there.z))
found["listed"] = [one.type_id for one in world.get_actors().filter("static.*")]
found["tags"] = list(cone.semantic_tags)
found["half_m"] = cone.bounding_box.extent.z
found["taken"] = world.try_spawn_actor(library.find("static.prop.barrel"), beside) is None
found["destroyed"] = cone.destroy()
world.tick()
found["left"] = len(world.get_actors().filter("static.*"))
""",
        )
    assert found["kinds"] > 40
    assert set(found["sizes"]) == {"tiny", "small", "medium", "big"}
    assert found["off_m"] < 0.01
    assert found["listed"] == ["static.prop.constructioncone"]
    assert found["tags"] == [PROP_TAG]
    assert found["half_m"] == pytest.approx(0.3, abs=1e-6)
    assert found["taken"]
    assert found["destroyed"]
    assert found["left"] == 0
