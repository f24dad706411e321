"""`cavmarl ros2`, and bags of recordings."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import yaml

import cavmarl
from cavmarl.cli import main
from cavmarl.cosim.ros2.ros_bag import BagWriter
from cavmarl.cosim.ros2.ros_types import RosMessage, RosTypes
from tests.cosim.ros2.conftest import Driver

pytestmark = pytest.mark.integration


def call(*words: str) -> None:
    with pytest.raises(SystemExit) as ended:
        main(list(words))
    assert not ended.value.code


def test_one_command_starts_a_world_and_its_bridge(
    types: RosTypes, domain: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = tmp_path / "report.json"
    with Driver(types, domain, {"/car_0/odometry": "geometry_msgs/msg/TwistStamped"}) as driver:
        call(
            "ros2", "grid4x4", "--agents", "2", "--background", "3", "--domain", str(domain),
            "--steps", "20", "--deadline-s", "5", "--json", str(report),
        )  # fmt: skip
        driver.wait_for("/car_0/odometry", 15)
    found = json.loads(report.read_text())
    assert found["controls"]["car_0"]["used"] == found["steps"] == 21
    assert found["sent"]["/clock"] == 21
    assert len(found["state_hash"]) == 32
    assert "/car_0/odometry" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "name either an environment to start, or a running world with --join"),
        (["town", "--join", "x.sock"], "name either an environment to start, or a running world"),
        (["--join", "x.sock", "--agents", "3"], "--agents: with --join, the world already runs"),
        (["--join", "x.sock", "--pace", "1"], "--pace: with --join, the world already runs"),
        (["--join", "missing.sock"], "missing.sock"),
        (["grid4x4", "--vehicle", "car_999"], "no agent 'car_999'"),
        (["grid4x4", "--domain", "500"], "domain = 500: must be from 0 to 101"),
        (
            ["grid4x4", "--deadline-s", "nan"],
            "deadline_s = nan: must be finite and at least 0",
        ),
        (["nowhere"], "nowhere"),
    ],
)
def test_wrong_options_are_refused_with_a_reason(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["ros2", *words])
    assert ended.value.code
    assert message in " ".join(capsys.readouterr().err.split())


def test_a_recording_becomes_a_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from rosbags.rosbag2 import Reader

    run, bag = tmp_path / "run", tmp_path / "bag"
    with closing(cavmarl.make_vec("grid4x4", agents=2, background=5)) as vec:
        vec.record(run)
        vec.reset(seed=1)
        frames = [vec.world_frames([0])[0]]
        for _ in range(6):
            vec.step(vec.suggest_actions())
            frames.append(vec.world_frames([0])[0])
    call("replay", str(run), "--rosbag2", str(bag))
    assert f"rosbag2: {bag}, 7 frames" in " ".join(capsys.readouterr().out.split())
    types, found = RosTypes(), dict[str, list[Any]]()
    with Reader(bag) as reader:
        for connection, when_ns, data in reader.messages():
            message = types.decode(connection.msgtype, bytes(data))
            found.setdefault(connection.topic, []).append((when_ns, message))
    assert [when_ns for when_ns, _ in found["/clock"]] == [
        round(1e9 * frame.time_s) for frame in frames
    ]
    for frame, (_, boxes), (_, moved) in zip(frames, found["/vehicles"], found["/tf"], strict=True):
        assert [box.id for box in boxes.markers] == frame.vehicles["id"].tolist()
        places = [(box.pose.position.x, box.pose.position.y) for box in boxes.markers]
        assert places == [(row["x"], row["y"]) for row in frame.vehicles]
        agents = frame.vehicles[frame.vehicles["agent"] >= 0]
        names = [one.child_frame_id for one in moved.transforms]
        assert names == [f"car_{agent}/body_link" for agent in agents["agent"]]
    with pytest.raises(SystemExit):
        main(["replay", str(run), "--rosbag2", str(bag)])
    assert "a bag cannot be made there" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(("distro", "version"), [("humble", 8), ("jazzy", 9), ("kilted", 9)])
def test_a_bag_has_the_metadata_that_its_distribution_reads(
    distro: str, version: int, tmp_path: Path
) -> None:
    from rosbags.rosbag2 import Reader

    bag, kind = tmp_path / "bag", "std_msgs/msg/UInt8MultiArray"
    types = RosTypes(distro)
    with closing(BagWriter(bag, types, {"/a": kind})) as writer:
        writer.write(RosMessage("/a", kind, 7, {"data": b"abc"}))
    read = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert read["version"] == version
    (topic,) = read["topics_with_message_count"]
    # up to version 8, QoS profiles are text; Humble reads only these versions
    assert isinstance(topic["topic_metadata"]["offered_qos_profiles"], str) == (version == 8)
    with Reader(bag) as reader:
        ((_, when_ns, data),) = reader.messages()
    assert when_ns == 7
    assert bytes(types.decode(kind, bytes(data)).data) == b"abc"
