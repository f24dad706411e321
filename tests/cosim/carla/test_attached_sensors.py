"""Sensors that are attached while a world runs measure its present state."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from typing import Any

import msgpack
import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.cosim.carla.attached_imaging import SEMANTIC_POINT
from cavmarl.cosim.carla.carla_actors import CarlaActor
from cavmarl.cosim.carla.carla_geodesy import geolocation
from cavmarl.cosim.carla.carla_geometry import CarlaPose, axes_of, compose, relative
from cavmarl.cosim.carla.carla_session import CarlaSession
from cavmarl.cosim.carla.vehicle_controls import (
    FULL_STEER_RAD,
    WHEELBASE_SHARE,
    CarlaControl,
    same_turn,
)
from tests.cosim.carla.conftest import make_server

ROOF = CarlaPose(0.0, 0.0, 2.0)


class Recorder:
    """Stores the frames of all streams."""

    def __init__(self) -> None:
        self.frames: dict[int, list[tuple[bytes, bytes]]] = {}

    def keep(self, stream: int, head: bytes, body: bytes, keep: bool) -> None:
        self.frames.setdefault(stream, []).append((head, body))


@pytest.fixture
def recorder(session: CarlaSession, monkeypatch: pytest.MonkeyPatch) -> Iterator[Recorder]:
    yield record_frames(monkeypatch)
    for actor in list(session.actors.attached()):
        session.destroy(actor.number)


def record_frames(monkeypatch: pytest.MonkeyPatch) -> Recorder:
    """Record the frames of all servers of this process."""
    found = Recorder()
    hub = "cavmarl.cosim.carla.carla_streams.StreamHub"
    monkeypatch.setattr(f"{hub}.is_wanted", lambda *_: True)
    monkeypatch.setattr(f"{hub}.send", lambda _, *frame: found.keep(*frame))
    return found


def ego(session: CarlaSession) -> CarlaActor:
    actor = session.actors.of_agent(1)
    assert actor is not None
    return actor


def attach(session: CarlaSession, kind: str, pose: CarlaPose = ROOF, **values: Any) -> CarlaActor:
    attributes = {name: str(value) for name, value in values.items()}
    return session.spawn(f"sensor.{kind}", attributes, pose, ego(session).number)


def stream_of(actor: CarlaActor) -> int:
    return int(struct.unpack_from("<I", actor.token)[0])


def newest(recorder: Recorder, actor: CarlaActor) -> bytes:
    return recorder.frames[stream_of(actor)][-1][1]


def test_a_relative_pose_inverts_a_composed_pose() -> None:
    outer = CarlaPose(1.0, -2.0, 3.0, 10.0, 50.0, -20.0)
    inner = CarlaPose(0.5, 0.2, 1.0, -5.0, 170.0, 30.0)
    assert relative(outer, compose(outer, inner)) == pytest.approx(inner)
    assert axes_of(outer) @ axes_of(outer).T == pytest.approx(np.eye(3))


def test_a_frame_has_the_number_of_its_tick(session: CarlaSession, recorder: Recorder) -> None:
    every, seldom = attach(session, "other.gnss"), attach(session, "other.gnss", sensor_tick=0.1)
    for _ in range(4):
        session.tick()
    numbers = [struct.unpack_from("<QQ", head)[1] for head, _ in recorder.frames[stream_of(every)]]
    assert numbers == list(range(session.frame - 3, session.frame + 1))
    assert len(recorder.frames[stream_of(seldom)]) == 2


def test_gnss_and_imu_agree_with_the_vehicle(session: CarlaSession, recorder: Recorder) -> None:
    gnss, imu = attach(session, "other.gnss"), attach(session, "other.imu")
    session.tick()
    pose = session.actors.pose_of(ego(session))
    latitude, longitude, altitude = msgpack.unpackb(newest(recorder, gnss))
    there = geolocation(session.map.origin, pose.x, pose.y, is_mercator=False)
    assert (latitude, longitude) == pytest.approx(there)
    assert altitude == pytest.approx(pose.z + 2.0)
    accelerometer, _, compass = msgpack.unpackb(newest(recorder, imu))
    assert accelerometer[2] == pytest.approx(9.81)
    north = math.degrees(compass) - pose.yaw
    assert math.remainder(north - 90.0, 360.0) == pytest.approx(0.0, abs=1e-3)


def points_of(body: bytes, form: Any) -> tuple[list[int], NDArray[Any]]:
    _, channels = struct.unpack_from("<fI", body)
    counts = list(struct.unpack_from(f"<{channels}I", body, 8))
    return counts, np.frombuffer(body, form, offset=8 + 4 * channels)


def test_a_lidar_hits_the_road_below_and_the_vehicles_around(
    session: CarlaSession, recorder: Recorder
) -> None:
    values = {
        "channels": 8,
        "points_per_second": 57_600,
        "rotation_frequency": 20,
        "range": 60,
        "upper_fov": 0,
        "lower_fov": -20,
    }
    plain = attach(
        session, "lidar.ray_cast", dropoff_general_rate=0, dropoff_zero_intensity=0, **values
    )
    semantic = attach(session, "lidar.ray_cast_semantic", **values)
    session.tick()
    counts, points = points_of(newest(recorder, plain), "<4f4")
    assert sum(counts) == len(points)
    assert counts[-1] == 360  # the lowest channel hits the road in all directions
    semantic_counts, tagged = points_of(newest(recorder, semantic), SEMANTIC_POINT)
    assert semantic_counts == counts
    assert tagged["place"] == pytest.approx(points[:, :3], abs=1e-4)
    road = tagged[tagged["tag"] == 1]
    assert road["place"][:, 2] == pytest.approx(-2.0, abs=1e-3)
    own = session.actors.pose_of(ego(session))
    for number in set(tagged["actor"].tolist()) - {0}:
        hit = session.actors.actors[number]
        there = relative(session.actors.pose_of(hit), own)
        in_its_frame = tagged["place"][tagged["actor"] == number] @ axes_of(there).T + [
            there.x, there.y, there.z + 2.0
        ]  # fmt: skip
        beyond = np.abs(in_its_frame - hit.centre) - hit.half_m
        assert beyond.max() < 0.02
        assert number != ego(session).number


def test_cameras_see_the_road_and_the_sky(session: CarlaSession, recorder: Recorder) -> None:
    size = {"image_size_x": 64, "image_size_y": 32}
    classes = attach(session, "camera.semantic_segmentation", **size)
    depth = attach(session, "camera.depth", **size)
    colours = attach(session, "camera.rgb", **size)
    session.tick()
    for actor in (classes, depth, colours):
        width, height, fov = struct.unpack_from("<IIf", newest(recorder, actor))
        assert (width, height, fov) == (64, 32, 90.0)
        assert len(newest(recorder, actor)) == 12 + 4 * 64 * 32
    tags = np.frombuffer(newest(recorder, classes), np.uint8, offset=12).reshape(32, 64, 4)[..., 2]
    assert tags[0, 32] == 11
    assert tags[31, 32] == 1
    coded = np.frombuffer(newest(recorder, depth), np.uint8, offset=12).reshape(32, 64, 4)
    metres = coded[..., :3] @ [65536.0, 256.0, 1.0] / (2**24 - 1) * 1000.0
    assert metres[0, 32] == pytest.approx(1000.0)
    # The camera is 2 m above the road, and its focal length is 32 pixels. The last row is
    # 15.5 pixels below the horizon.
    assert metres[31, 32] == pytest.approx(2.0 * 32.0 / 15.5, rel=1e-3)


def test_a_camera_behind_its_vehicle_sees_the_vehicle(
    session: CarlaSession, recorder: Recorder
) -> None:
    behind = CarlaPose(-7.0, 0.0, 3.0, -15.0)
    camera = attach(
        session, "camera.instance_segmentation", behind, image_size_x=32, image_size_y=32
    )
    session.tick()
    pixels = np.frombuffer(newest(recorder, camera), np.uint8, offset=12).reshape(32, 32, 4)
    numbers = pixels[..., 1].astype(int) + 256 * pixels[..., 0].astype(int)
    assert ego(session).number in numbers
    assert 14 in pixels[..., 2]


SIZE = {"image_size_x": 96, "image_size_y": 64}


def test_optical_flow_points_to_the_same_vehicle_in_the_previous_picture(
    session: CarlaSession, recorder: Recorder
) -> None:
    behind = CarlaPose(-8.0, 0.0, 3.0, -12.0)
    flow, instances = (
        attach(session, f"camera.{kind}", behind, **SIZE)
        for kind in ("optical_flow", "instance_segmentation")
    )
    session.tick()
    assert not np.frombuffer(newest(recorder, flow), "<f4", offset=12).any(), (
        "the first picture has no flow"
    )
    row, column = np.mgrid[:64, :96]
    others, roads = [], []
    for _ in range(30):
        before = numbers_in(picture_of(recorder, instances))
        session.tick()
        shown = numbers_in(picture_of(recorder, instances))
        moved = np.frombuffer(newest(recorder, flow), "<f4", offset=12).reshape(64, 96, 2)
        right, down = moved[..., 0] * 48.0, -moved[..., 1] * 32.0
        own = shown == ego(session).number
        assert own.any()
        # The camera and its vehicle move together.
        assert np.hypot(right[own], down[own]).max() < 0.02
        roads.append(np.hypot(right, down)[~own].max())
        was = np.rint(row - down).astype(int), np.rint(column - right).astype(int)
        inside = (0 <= was[0]) & (was[0] < 64) & (0 <= was[1]) & (was[1] < 96)
        inside &= (shown > 0) & ~own
        others.append(shown[inside] == before[was[0][inside], was[1][inside]])
    assert max(roads) > 2.0, "the vehicle does not drive"
    found = np.concatenate(others)
    assert len(found) > 50
    assert found.mean() > 0.9


def numbers_in(picture: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return the number of the actor at each pixel of an instance camera; 0 means no actor."""
    return picture[..., 1].astype(np.int64) + 256 * picture[..., 0].astype(np.int64)


def picture_of(recorder: Recorder, actor: CarlaActor) -> NDArray[np.uint8]:
    return np.frombuffer(newest(recorder, actor), np.uint8, offset=12).reshape(64, 96, 4)


def test_optical_flow_of_the_road_matches_the_motion_of_the_camera(
    session: CarlaSession, recorder: Recorder
) -> None:
    """If the camera moves straight ahead over a flat road, the flow of each row has a formula."""
    flow = attach(session, "camera.optical_flow", ROOF, **SIZE)
    depth = attach(session, "camera.depth", ROOF, **SIZE)
    session.tick()
    for _ in range(40):
        before = flow.pose
        session.tick()
        after = flow.pose
        way = axes_of(after).T @ (np.array(after.place) - before.place)
        turned = abs(math.remainder(after.yaw - before.yaw, 360.0))
        if way[0] > 0.2 and turned < 1e-3:
            break
    else:
        pytest.fail("the vehicle does not drive straight on")
    moved = np.frombuffer(newest(recorder, flow), "<f4", offset=12).reshape(64, 96, 2)
    depth_m = picture_of(recorder, depth)[..., :3].astype(float) @ [65536.0, 256.0, 1.0]
    depth_m *= 1000.0 / (2**24 - 1)
    # A point of the road, 2 m below the camera, is 48 · 2 / depth pixels below the middle.
    for row in (56, 60, 63):
        below = (row + 0.5 - 32.0) / 48.0  # tangent of the angle
        assert depth_m[row, 48] == pytest.approx(2.0 / below, rel=1e-3), (
            "the pixel does not show the road"
        )
        d, before_d = depth_m[row, 48], depth_m[row, 48] + way[0]
        down = 48.0 * (2.0 / d - 2.0 / before_d)
        assert moved[row, 48, 1] * 32.0 == pytest.approx(-down, rel=0.01)


def test_a_radar_detects_targets_only_inside_its_cone(
    session: CarlaSession, recorder: Recorder
) -> None:
    radar = attach(session, "other.radar", CarlaPose(2.4, 0.0, 1.0), points_per_second=20_000)
    session.tick()
    found = np.frombuffer(newest(recorder, radar), "<4f4")
    assert len(found) > 100
    assert np.abs(found[:, 1:3]).max() <= math.radians(15.0) + 1e-6
    assert (found[:, 3] > 0.0).all()
    assert (found[:, 3] <= 100.0).all()


def test_sensors_are_removed_with_their_vehicle(session: CarlaSession, recorder: Recorder) -> None:
    parent = ego(session)
    attached = attach(session, "other.imu")
    gone = session.actors.remove(parent.number)
    assert attached in gone
    session.load("", False)


def test_a_collision_is_reported_with_the_last_frame_of_its_vehicle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = record_frames(monkeypatch)
    with make_server(agents=1, background=150) as server:
        session = server.session
        agent = session.actors.of_agent(0)
        assert agent is not None
        sensor = session.spawn("sensor.other.collision", {}, ROOF, agent.number)
        steering_rad = session.world.env.config.action.steering_rad
        for _ in range(1000):
            # The wheelbase of an agent equals its length; CARLA's vehicles have a shorter one.
            angle = steering_rad * float(session.world.env.suggest_actions()["car_0"][1])
            steer = -same_turn(angle, WHEELBASE_SHARE) / FULL_STEER_RAD
            session.world.controls[0] = CarlaControl(throttle=0.7, steer=steer)
            session.tick()
            if stream_of(sensor) in found.frames:
                break
        ((head, body),) = found.frames[stream_of(sensor)]
        assert struct.unpack_from("<QQ", head) == (0, session.frame)
        own, other, impulse = msgpack.unpackb(body)
        assert own[0] == agent.number
        assert other[0] != agent.number
        assert len(impulse) == 3
        assert agent.number not in session.actors.actors
