"""A recording as a bag of rosbag2: the vehicles as boxes, the frames of agents, and the signals."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np

from cavmarl.cosim.followers.follower_snapshots import TRUTH
from cavmarl.cosim.ros2.ros_bag import BagWriter
from cavmarl.cosim.ros2.ros_topics import CLOCK, SIGNALS, TF, VEHICLES, kinds_of_world
from cavmarl.cosim.ros2.ros_types import RosMessage, RosTypes, time_of
from cavmarl.cosim.ros2.sensor_messages import markers, quaternion_of, transform, turn_of
from cavmarl.engine.world_frame import WorldFrame
from cavmarl.recordings.recording import Recording
from cavmarl.roads.shown_signals import signal_codes

Track = Callable[[Iterator[WorldFrame]], Iterable[WorldFrame]]


def write_recording_bag(
    recording: Recording,
    folder: Path,
    world: int,
    episode: int,
    track: Track = iter,
    distro: str = "jazzy",
) -> int:
    """Write an episode as a bag.

    `/vehicles` has a box for each vehicle, `/tf` the frame `car_K/body_link` of each agent, below
    the centre of its body, and `/signals` the SIGNAL_* code of each link.

    Args:
        recording: the recording.
        folder: a new folder.
        world: index of the world.
        episode: index of the episode.
        track: wraps the frames to show the progress.
        distro: distribution whose types are written.

    Returns:
        the number of frames.

    Raises:
        RecordingError: the folder exists, or the recording cannot be read.
        MissingExtraError: the extra `ros2` is not installed.
    """
    types, kinds = RosTypes(distro), kinds_of_world(truth=True)
    count, life_ns, before_ns = 0, 10**9, 0
    with closing(BagWriter(folder, types, kinds)) as bag:
        for frame in track(recording.frames(world, episode)):
            now_ns = round(1e9 * frame.time_s)
            if count:
                life_ns = 2 * (now_ns - before_ns)
            before_ns = now_ns
            rows = [
                dict(zip(TRUTH, (float(row[name]) for name in TRUTH), strict=True))
                for row in frame.vehicles
            ]
            moved = [
                transform(
                    now_ns,
                    "map",
                    f"car_{int(row['agent'])}/body_link",
                    (row["x"], row["y"], row["z"]),
                    quaternion_of(turn_of(row["heading"], row["pitch"])),
                )
                for row in rows
                if row["agent"] >= 0
            ]
            codes = signal_codes(recording.network, frame.signals)
            for topic, fields in (
                (VEHICLES, markers(rows, now_ns, life_ns)),
                (TF, {"transforms": moved}),
                (SIGNALS, {"data": np.asarray(codes, dtype=np.uint8)}),
                (CLOCK, {"clock": time_of(now_ns)}),
            ):
                bag.write(RosMessage(topic, kinds[topic], now_ns, fields))
            count += 1
    return count
