"""`BagWriter`: ROS messages in a bag of rosbag2, which `ros2 bag play` and Foxglove read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cavmarl.core.errors import RecordingError, require
from cavmarl.cosim.ros2.ros_types import RosMessage, RosTypes

# Version of `metadata.yaml` that each distribution writes.
_VERSIONS = {"humble": 8, "jazzy": 9, "kilted": 9}


class BagWriter:
    """A bag in MCAP, with the simulated time of each message.

    Args:
        folder: a new folder.
        types: message types.
        kinds: type of each topic.
        latched: topics whose last message late subscribers get.

    Raises:
        RecordingError: the folder exists or cannot be written.
        MissingExtraError: the extra `ros2` is not installed.
    """

    def __init__(
        self, folder: Path, types: RosTypes, kinds: Mapping[str, str], latched: Sequence[str] = ()
    ) -> None:
        rosbag2: Any = require("rosbags.rosbag2", "ros2")
        self._types, self._kinds, self._latched = types, kinds, latched
        self._interfaces: Any = require("rosbags.interfaces", "ros2")
        try:
            self._writer = rosbag2.Writer(
                folder,
                version=_VERSIONS[types.distro],
                storage_plugin=rosbag2.StoragePlugin.MCAP,
            )
            self._writer.open()
        except (OSError, rosbag2.WriterError) as error:
            raise RecordingError(
                f"{folder}: a bag cannot be made there ({error}); name a new folder"
            ) from error
        self._connections: dict[str, Any] = {}

    def write(self, message: RosMessage, data: bytes | None = None) -> None:
        """Write a message; `data`: its encoding in CDR, if the caller has it."""
        topic = message.topic
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic,
                self._kinds[topic],
                typestore=self._types.store,
                offered_qos_profiles=self._profiles(topic),
            )
        if data is None:
            data = self._types.encode(message.kind, message.fields)
        self._writer.write(self._connections[topic], message.stamp_ns, data)

    def close(self) -> None:
        """Finish the bag; repeated calls do nothing."""
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.close()

    def _profiles(self, topic: str) -> list[Any]:
        names = self._interfaces
        is_latched = topic in self._latched
        durability = names.QosDurability
        duration = names.QosTime(0, 0)
        return [
            names.Qos(
                names.QosHistory.KEEP_LAST,
                1 if is_latched else 10,
                names.QosReliability.RELIABLE,
                durability.TRANSIENT_LOCAL if is_latched else durability.VOLATILE,
                duration,
                duration,
                names.QosLiveliness.AUTOMATIC,
                duration,
                False,
            )
        ]
