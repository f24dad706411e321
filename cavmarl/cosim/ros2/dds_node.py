"""`DdsNode`: a ROS 2 node on DDS, by Cyclone DDS and without ROS.

Names, qualities of service and encodings are as in ROS's middleware (rmw_cyclonedds_cpp and
rmw_fastrtps_cpp); docs/reference/ros2.md lists them.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from threading import Lock
from typing import Any, NamedTuple, Self
from weakref import WeakValueDictionary

from cavmarl.core.errors import ConfigError, RosError, require
from cavmarl.cosim.ros2.ros_types import RosTypes

MAX_DOMAIN = 101  # higher domains need ports that Linux gives to other programs
_MAX_PARTICIPANTS = 32  # programs that share a domain on this machine
_KEPT_SAMPLES = 10  # messages of a topic that wait until they are read
# Types with large messages (some MB), which arrive one by one. Several messages of other types may
# arrive at once, and a node that is busy for a second must not lose them.
LARGE = ("sensor_msgs/msg/Image", "sensor_msgs/msg/PointCloud2")
_KEPT_SMALL = 200
_PARTS = ("builtin", "core", "domain", "idl", "pub", "qos", "sub", "topic", "util")
_MOST_ENDPOINTS = 4096  # limit of one read
_MAX_BLOCKING_S = 10
_GRAPH = "ros_discovery_info"
_GRAPH_KIND = "rmw_dds_common/msg/ParticipantEntitiesInfo"

# Programs of this machine find each other by the loopback interface, without multicast.
_LOOPBACK = f"""<CycloneDDS><Domain id="any">
<General><Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>
<AllowMulticast>false</AllowMulticast><MaxMessageSize>65500B</MaxMessageSize></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>{_MAX_PARTICIPANTS}</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>"""

_DOMAINS: WeakValueDictionary[int, Any] = WeakValueDictionary()  # domains of this process
_LOCK = Lock()


class Received(NamedTuple):
    """A message that has arrived."""

    data: bytes  # in CDR
    sender: bytes  # identity of its publisher


class DdsNode:
    """A node with publishers and subscriptions on one domain.

    The node reaches programs on this machine. If the environment variable `CYCLONEDDS_URI` is set,
    the node uses the network of that configuration.

    Args:
        types: message types.
        name: name of the node.
        domain: ROS_DOMAIN_ID.
        publishers: message type of each published topic.
        subscriptions: message type of each subscribed topic.
        latched: topics whose last message late subscribers get.

    Raises:
        ConfigError: the domain is out of range.
        RosError: DDS cannot be started.
        MissingExtraError: the extra `ros2` is not installed.
    """

    def __init__(
        self,
        types: RosTypes,
        name: str,
        domain: int,
        publishers: Mapping[str, str],
        subscriptions: Mapping[str, str],
        latched: Sequence[str] = (),
    ) -> None:
        if not 0 <= domain <= MAX_DOMAIN:
            raise ConfigError(f"domain = {domain}: must be from 0 to {MAX_DOMAIN}")
        self._types, self._name = types, name
        self._dds = {part: require(f"cyclonedds.{part}", "ros2") for part in _PARTS}
        self._classes: dict[str, Any] = {}
        self._domain: Any = None
        try:
            if not os.environ.get("CYCLONEDDS_URI"):
                self._domain = _loopback(self._dds["domain"].Domain, domain)
            quality = self._dds["qos"]
            self._participant: Any = self._dds["domain"].DomainParticipant(
                domain, qos=quality.Qos(quality.Policy.Userdata(b"enclave=/;"))
            )
            self._writers = {
                topic: self._writer(
                    f"rt{topic}", kind, topic in latched, 1 if topic in latched else _kept(kind)
                )
                for topic, kind in publishers.items()
            }
            self._readers = {
                topic: self._reader(f"rt{topic}", kind, topic in latched)
                for topic, kind in subscriptions.items()
            }
            self._kinds = {**publishers, **subscriptions}
            builtin = self._dds["builtin"]
            self._endpoints = [
                builtin.BuiltinDataReader(self._participant, topic)
                for topic in (
                    builtin.BuiltinTopicDcpsPublication,
                    builtin.BuiltinTopicDcpsSubscription,
                )
            ]
            self._graph = self._writer(_GRAPH, _GRAPH_KIND, True, 1)
            self._tell_graph()
            core = self._dds["core"]
            self._wait_set = core.WaitSet(self._participant)
            states = core.SampleState.NotRead | core.ViewState.Any | core.InstanceState.Any
            for reader in self._readers.values():
                self._wait_set.attach(core.ReadCondition(reader, states))
        except self._dds["core"].DDSException as error:
            raise RosError(
                f"DDS cannot be started on domain {domain}: {error}; choose another domain, or "
                f"correct CYCLONEDDS_URI. At most {_MAX_PARTICIPANTS} programs share a domain"
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def publish(self, topic: str, data: bytes) -> None:
        """Send a message in CDR.

        Raises RosError: a subscriber does not read for `_MAX_BLOCKING_S` seconds.
        """
        cls = self._classes[self._kinds[topic]]
        try:
            self._writers[topic].write(_sample(cls, data))
        except self._dds["core"].DDSException as error:
            raise RosError(f"{topic}: the message cannot be sent: {error}") from error

    def take(self, topic: str) -> list[Received]:
        """Return the messages that have arrived since the last call, the oldest first."""
        found = []
        for sample in self._readers[topic].take(_KEPT_SAMPLES):
            data = getattr(sample, "cdr", None)
            if data is not None:  # a sample without data says that a publisher has left
                found.append(Received(data, sample.sample_info.publication_handle))
        return found

    def wait(self, seconds: float) -> None:
        """Wait until a message of any subscription has arrived, or until the time is over."""
        duration = self._dds["util"].duration(nanoseconds=max(0, round(1e9 * seconds)))
        self._wait_set.wait(duration)

    def subscribers_of(self, topic: str) -> int:
        """Return the number of subscriptions that this node's publisher of a topic serves."""
        return len(self._writers[topic].get_matched_subscriptions())

    def publishers_of(self, topic: str) -> int:
        """Return the number of publishers of a topic to which this node has subscribed."""
        return len(self._readers[topic].get_matched_publications())

    def kind_of(self, topic: str) -> str:
        """Return the type of one of this node's topics."""
        return self._kinds[topic]

    def mismatches(self) -> list[tuple[str, str]]:
        """Return topic and type of each endpoint that has this node's topic with another type.

        Such endpoints are not connected, and DDS reports no error. Each is returned once.
        """
        found = []
        for reader in self._endpoints:
            for endpoint in reader.take(_MOST_ENDPOINTS):
                # Samples of closed endpoints have no names.
                topic = (endpoint.topic_name or "").removeprefix("rt")
                kind = self._kinds.get(topic)
                if kind is not None and endpoint.type_name != _dds_name(kind):
                    found.append((topic, _ros_name(endpoint.type_name)))
        return found

    def close(self) -> None:
        """Leave the domain; repeated calls do nothing."""
        participant, self._participant = self._participant, None
        if participant is None:
            return
        # DDS deletes an entity when its last reference is gone.
        self._writers, self._readers = {}, {}
        del self._graph, self._wait_set, self._endpoints
        with suppress(Exception):
            self._dds["core"].Entity.__del__(participant)
        self._domain = None

    def _writer(self, topic: str, kind: str, latched: bool, depth: int) -> Any:
        return self._dds["pub"].DataWriter(
            self._participant,
            self._dds["topic"].Topic(self._participant, topic, self._class_of(kind)),
            qos=self._quality(kind, latched, depth),
        )

    def _reader(self, topic: str, kind: str, latched: bool) -> Any:
        return self._dds["sub"].DataReader(
            self._participant,
            self._dds["topic"].Topic(self._participant, topic, self._class_of(kind)),
            qos=self._quality(kind, latched, _KEPT_SAMPLES, is_writer=False),
        )

    def _quality(self, kind: str, latched: bool, depth: int, is_writer: bool = True) -> Any:
        policy = self._dds["qos"].Policy
        duration = self._dds["util"].duration
        # Publishers offer the strongest quality of service, so that every subscriber matches.
        # Subscribers ask for the weakest, so that every publisher matches. Only reliable
        # subscribers get latched messages.
        reliable = policy.Reliability.Reliable(duration(seconds=_MAX_BLOCKING_S))
        policies = [
            reliable if is_writer or latched else policy.Reliability.BestEffort,
            policy.Durability.TransientLocal if latched else policy.Durability.Volatile,
            policy.History.KeepLast(depth),
            policy.DataRepresentation(use_cdrv0_representation=True),  # XCDR1
            policy.WriterDataLifecycle(autodispose=False),
            policy.Userdata(f"typehash={self._types.type_hash(kind)};".encode()),
        ]
        if latched and is_writer:
            kept = policy.History.KeepLast(depth)
            policies.append(
                policy.DurabilityService(duration(seconds=0), kept, -1, -1, -1),
            )
        return self._dds["qos"].Qos(*policies)

    def _class_of(self, kind: str) -> Any:
        """Return the DDS class of a type, described field by field; its samples hold CDR bytes."""
        if kind in self._classes:
            return self._classes[kind]
        nodes: Any = require("rosbags.interfaces", "ros2").Nodetype
        idl = self._dds["idl"]
        base = {"bool": bool, "string": str, "float32": idl.types.float32}
        base |= {"float64": idl.types.float64, **dict.fromkeys(("byte", "octet"), idl.types.uint8)}
        base["char"] = idl.types.uint8
        for sign in ("", "u"):
            for bits in (8, 16, 32, 64):
                base[f"{sign}int{bits}"] = getattr(idl.types, f"{sign}int{bits}")

        def described(node: Any) -> Any:
            what, detail = node
            if what == nodes.BASE:
                return base[detail[0]]
            if what == nodes.NAME:
                return self._class_of(detail)
            inner = described(detail[0])
            if what == nodes.ARRAY:
                return idl.types.array[inner, detail[1]]
            return idl.types.sequence[inner]

        name = kind.rpartition("/")[2]
        fields = {field: described(node) for field, node in self._types.fields_of(kind)}
        cls = idl.make_idl_struct(f"{name}_", _dds_name(kind), fields)

        # The signatures equal the signatures of Cyclone DDS's own methods.
        def serialize(
            self: Any, buffer: Any = None, endianness: Any = None, use_version_2: Any = None
        ) -> bytes:
            data: bytes = self.cdr
            return data

        def deserialize(data: bytes, has_header: bool = True, use_version_2: Any = None) -> Any:
            return _sample(cls, bytes(data))

        cls.serialize, cls.deserialize = serialize, staticmethod(deserialize)
        self._classes[kind] = cls
        return cls

    def _tell_graph(self) -> None:
        """Publish the name of the node, for `ros2 node list`."""
        size = self._types.fields_of("rmw_dds_common/msg/Gid")[0][1][1][1]

        def gid(entity: Any) -> dict[str, Any]:
            return {"data": entity.guid.bytes.ljust(size, b"\0")}

        node = {
            "node_namespace": "/",
            "node_name": self._name,
            "reader_gid_seq": [gid(reader) for reader in self._readers.values()],
            "writer_gid_seq": [gid(writer) for writer in self._writers.values()],
        }
        fields = {"gid": gid(self._participant), "node_entities_info_seq": [node]}
        data = self._types.encode(_GRAPH_KIND, fields)
        self._graph.write(_sample(self._classes[_GRAPH_KIND], data))


def _kept(kind: str) -> int:
    """Return the number of messages that a publisher keeps for subscribers that are busy."""
    return _KEPT_SAMPLES if kind in LARGE else _KEPT_SMALL


def _dds_name(kind: str) -> str:
    """Return the DDS name of a ROS type."""
    package, folder, name = kind.split("/")
    return f"{package}::{folder}::dds_::{name}_"


def _ros_name(name: str) -> str:
    """Return the ROS name of a DDS type."""
    return name.replace("::dds_", "").replace("::", "/").removesuffix("_")


def _loopback(make: Any, domain: int) -> Any:
    """Return the domain on the loopback interface; a process can open each domain once."""
    with _LOCK:
        found = _DOMAINS.get(domain)
        if found is None:
            found = _DOMAINS[domain] = make(domain, _LOOPBACK)
        return found


def _sample(cls: Any, data: bytes) -> Any:
    sample = cls.__new__(cls)
    sample.cdr = data
    return sample
