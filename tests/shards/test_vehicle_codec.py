"""The state of a vehicle as bytes: vehicles continue exactly, and wrong bytes are refused."""

from __future__ import annotations

import json
import os
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from cavmarl.config.registry import entries
from cavmarl.core.errors import (
    MessageError,
)
from cavmarl.driving.vehicles import RECORD_VERSION, VEHICLE
from cavmarl.engine.simulation import Simulation
from cavmarl.sensors.observed import carried_from
from cavmarl.shards.phases import Phase
from cavmarl.shards.shard import Commands
from cavmarl.shards.vehicle_codec import GROUPS, TransferCodec, layout_text
from tests.support.demand_worlds import make
from tests.support.driving import idle, make_simulation, start, suggested
from tests.support.generated import check_block, table
from tests.support.world import PhaseLog, executor_of, use_executor

ROOT = Path(__file__).resolve().parents[2]
GOLDEN = Path(__file__).parent / "transfer_v1.json"
SCRIBBLE = 0xAB


def codec_of(simulation: Simulation) -> TransferCodec:
    carried = carried_from(simulation.config.sensors)
    return TransferCodec.of(simulation.shards[0].worlds, simulation.outputs, carried)


# Whole worlds

MIXED = """<routes>
  <vType id="bus" vClass="bus"/>
  <vType id="truck" vClass="truck"/>
  <vType id="car" sigma="0.6" speedFactor="normc(1,0.1,0.8,1.2)"/>
  <vTypeDistribution id="some" vTypes="car bus truck" probabilities="2 1 1"/>
  <route id="straight" edges="main_in weave main_out"/>
  <vehicle id="first" type="bus" route="straight" depart="0" departLane="0">
    <stop lane="main_in_0" endPos="60" duration="8"/>
  </vehicle>
  <flow id="main" type="some" route="straight" begin="1" end="90" period="2.5"
        departLane="free" departPos="base" departSpeed="max"/>
  <flow id="ramp" type="car" from="ramp" to="main_out" begin="1" end="90" period="4"/>
</routes>"""


def lifted(shape: re.Match[str]) -> str:
    points = (point.split(",") for point in shape[1].split())
    return 'shape="' + " ".join(f"{x},{y},{0.04 * float(x):.3f}" for x, y in points) + '"'


@pytest.fixture(scope="module")
def hilly(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Write the roads of `merge` with a slope of 4 % to the east, and cars, buses and trucks."""
    folder = tmp_path_factory.mktemp("hilly")
    roads, demand = folder / "hills.net.xml", folder / "mixed.rou.xml"
    flat = (ROOT / "envs/merge/map/map.net.xml").read_text(encoding="utf-8")
    roads.write_text(re.sub(r'shape="([^"]*)"', lifted, flat), encoding="utf-8")
    demand.write_text(MIXED, encoding="utf-8")
    return roads, demand


def rough_world(files: tuple[Path, Path], **overrides: Any) -> Simulation:
    """Make worlds with delayed actions, stacked frames, agents, a demand and long steps."""
    roads, demand = files
    settings = {
        "clock.sim_dt_s": 0.1,
        "clock.ctrl_dt_s": 0.3,
        "clock.control_latency_ticks": 4,
        "sensors.stack": 3,
        "sensors.lidar.rays": 8,
        **overrides,
    }
    simulation = make(roads, [demand], agents=4, num_worlds=2, overrides=settings)
    start(simulation, seed=3)
    return simulation


def carry_all(simulation: Simulation) -> None:
    """Pack each vehicle, overwrite all packed arrays, and unpack the vehicles in another order."""
    worlds, codec = simulation.shards[0].worlds, codec_of(simulation)
    packed = []
    for w, num in enumerate(worlds.num_owned.tolist()):
        tick, rows = int(worlds.ticks[w]), worlds.rows
        packed.append([(rows[w, i]["id"], codec.pack(rows, w, i, tick)) for i in range(num)])
    for array in (worlds.rows, worlds.next_rows, worlds.pending, simulation.outputs.observations):
        array.view(np.uint8)[...] = SCRIBBLE
    for w, states in enumerate(packed):
        for i, (vehicle, state) in enumerate(reversed(states)):
            codec.unpack(state, int(vehicle), int(worlds.ticks[w]), worlds.rows, w, i)


class Carrier(PhaseLog):
    """An executor that packs and unpacks all vehicles after their last motion."""

    def __init__(self, simulation: Simulation) -> None:
        super().__init__(executor_of(simulation))
        self.seen = np.zeros(0, dtype=VEHICLE)
        self._simulation = simulation

    def run(self, phase: Phase, arguments: tuple[Any, ...]) -> None:
        super().run(phase, arguments)
        if phase is Phase.DETECT:
            carry_all(self._simulation)
            self.seen = np.concatenate([self.seen, self._simulation.vehicles(0)])


def trace(simulation: Simulation, steps: int = 60) -> list[bytes]:
    """Yield the results of agents and the states of the worlds, step by step."""
    found, rng = [], np.random.default_rng(1)
    for _ in range(steps):
        noise = rng.normal(0.0, (2.0, 0.02), size=(*simulation.outputs.present.shape, 2))
        simulation.step(Commands(suggested(simulation) + noise, idle(simulation).meta_actions))
        found += [array.tobytes() for array in simulation.outputs]
        simulation.retire_agents()
        found += [simulation.state_hash(w).encode() for w in range(simulation.num_worlds)]
    return found


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_vehicles_that_are_packed_every_tick_continue_bit_for_bit(
    hilly: tuple[Path, Path], kind: str
) -> None:
    expected = trace(rough_world(hilly, **{"action.kind": kind}))
    carried = rough_world(hilly, **{"action.kind": kind})
    carrier = Carrier(carried)
    use_executor(carried, carrier)
    assert trace(carried) == expected
    seen = carrier.seen
    assert len(np.unique(seen["vtype"])) >= 4  # cars from the generator and from the demand file
    assert len(np.unique(seen["length"])) >= 3
    assert np.ptp(seen["z"]) > 1.0
    assert (seen["pitch"] > 0.03).any()
    assert (seen["agent"] >= 0).any()
    assert (seen["stopped_s"] > 0.0).any()


@pytest.mark.parametrize("lost", ["pending", "observations"])
def test_a_change_of_arrays_outside_of_the_record_changes_the_run(
    hilly: tuple[Path, Path], lost: str
) -> None:
    whole, spoiled = rough_world(hilly), rough_world(hilly)
    assert trace(whole, 4) == trace(spoiled, 4)
    arrays = {**spoiled.worlds._asdict(), **spoiled.outputs._asdict()}
    arrays[lost][...] = 0.125
    assert trace(whole, 4) != trace(spoiled, 4)


# Sizes


@pytest.mark.parametrize("entry", entries())
def test_a_state_is_under_four_kilobytes(entry: str) -> None:
    simulation = make_simulation(entry, mode="respawn", agents=2, background=2)
    start(simulation, seed=0)
    codec, rows = codec_of(simulation), simulation.worlds.rows
    sizes = [len(codec.pack(rows, 0, i, 0)) for i in range(len(simulation.vehicles()))]
    assert max(sizes) < 4000
    assert min(sizes) < 450


def test_sensor_readings_are_not_transferred() -> None:
    def size(stack: int) -> int:
        sensors = {"sensors.lidar.rays": 360, "sensors.stack": stack}
        simulation = make_simulation(
            "ring", mode="closed", agents=1, background=0, overrides=sensors
        )
        start(simulation, seed=0)
        return len(codec_of(simulation).pack(simulation.worlds.rows, 0, 0, 0))

    assert size(1) < 480
    assert size(2) - size(1) > 4 * 360
    assert size(3) - size(2) == size(2) - size(1)


# One record

AGENTS, TICKS, NUMBERS = 3, 3, 5
TICK = 77
Arrays = tuple[TransferCodec, NDArray[np.void], NDArray[np.float64], NDArray[np.float32]]


def arrays(record: np.dtype[np.void] = VEHICLE, agents: int = AGENTS) -> Arrays:
    """Return a codec for two worlds of four rows, with rows, commands and frames of garbage."""
    rows = np.empty((2, 4), dtype=record)
    commands = np.empty((2, agents, TICKS, 2))
    frames = np.empty((2, agents, NUMBERS), dtype=np.float32)
    for array in (rows, commands, frames):
        array.view(np.uint8)[...] = SCRIBBLE
    return TransferCodec(record, commands, frames), rows, commands, frames


def fill_row(record: np.dtype[np.void], agent: int) -> Arrays:
    """Return `arrays` in which row 2 of world 1 has a different value in each field."""
    codec, rows, commands, frames = arrays(record)
    for k, name in enumerate(record.names or ()):
        rows[name][1, 2] = 10 + k
    rows["agent"][1, 2], rows["transfer"][1, 2] = agent, 0
    commands[1, agent] = np.arange(2 * TICKS).reshape(TICKS, 2) / 8.0
    frames[1, agent] = -np.arange(NUMBERS) / 4.0
    return codec, rows, commands, frames


def make_state() -> tuple[bytes, int]:
    """Return a packed state of tick `TICK`, and the id of its vehicle."""
    codec, rows, _, _ = fill_row(VEHICLE, agent=1)
    return codec.pack(rows, 1, 2, TICK), int(rows[1, 2]["id"])


def unpack_state(state: bytes, vehicle: int, tick: int) -> np.void:
    codec, rows, _, _ = arrays()
    codec.unpack(state, vehicle, tick, rows, 0, 3)
    row: np.void = rows[0, 3]
    return row


@pytest.mark.parametrize("agent", [-1, 0, 2])
def test_unpacking_sets_every_field_and_changes_no_other_row(agent: int) -> None:
    codec, rows, commands, frames = fill_row(VEHICLE, agent)
    state = codec.pack(rows, 1, 2, TICK)
    sent = rows[1, 2].copy()
    other, there, their_commands, their_frames = arrays()
    untouched = there.tobytes()
    other.unpack(state, int(sent["id"]), TICK, there, 0, 3)
    for name in VEHICLE.names or ():
        assert there[0, 3][name] == sent[name], name
    assert other.pack(there, 0, 3, TICK) == state
    there.view(np.uint8).reshape(2, 4, -1)[0, 3] = SCRIBBLE
    assert there.tobytes() == untouched
    changed = [their_commands.view(np.uint8) != SCRIBBLE, their_frames.view(np.uint8) != SCRIBBLE]
    if agent < 0:
        assert not any(array.any() for array in changed)
        return
    np.testing.assert_array_equal(their_commands[0, agent], commands[1, agent])
    np.testing.assert_array_equal(their_frames[0, agent], frames[1, agent])
    assert not any(array[1].any() for array in changed)
    assert not any(np.delete(array[0], agent, axis=0).any() for array in changed)


@given(record=st.binary(min_size=VEHICLE.itemsize, max_size=VEHICLE.itemsize),
       apart=st.binary(min_size=8 * 2 * TICKS + 4 * NUMBERS, max_size=8 * 2 * TICKS + 4 * NUMBERS),
       agent=st.integers(-1, AGENTS - 1))  # fmt: skip
def test_any_unpacked_record_equals_the_packed_record(
    record: bytes, apart: bytes, agent: int
) -> None:
    codec, rows, commands, frames = arrays()
    rows[1, 2] = np.frombuffer(record, VEHICLE)[0]
    rows["agent"][1, 2], rows["transfer"][1, 2] = agent, 0
    commands[1, agent] = np.frombuffer(apart, "<f8", 2 * TICKS).reshape(TICKS, 2)
    frames[1, agent] = np.frombuffer(apart, "<f4", NUMBERS, 8 * 2 * TICKS)
    state = codec.pack(rows, 1, 2, TICK)
    other, there, _, _ = arrays()
    other.unpack(state, int(rows[1, 2]["id"]), TICK, there, 0, 0)
    assert there[0, :1].tobytes() == rows[1, 2:3].tobytes()
    assert other.pack(there, 0, 0, TICK) == state


# Refused states

RECORD_AT = 44


def test_invalid_bytes_are_refused_with_the_reason() -> None:
    state, vehicle = make_state()
    header, other = bytearray(state), RECORD_VERSION + 1
    for length in range(len(state)):
        with pytest.raises(MessageError):
            unpack_state(state[:length], vehicle, TICK)
    with pytest.raises(MessageError, match=f"{len(state) + 1} bytes"):
        unpack_state(state + b"\0", vehicle, TICK)
    with pytest.raises(MessageError, match="begins with"):
        unpack_state(b"CVMO" + state[4:], vehicle, TICK)
    with pytest.raises(
        MessageError, match=rf"version {other}\.0, but this build reads {RECORD_VERSION}\."
    ):
        unpack_state(state[:4] + struct.pack("<H", other) + state[6:], vehicle, TICK)
    with pytest.raises(MessageError, match=f"expected vehicle {vehicle + 1}"):
        unpack_state(state, vehicle + 1, TICK)
    with pytest.raises(MessageError, match=f"at tick {TICK + 1}"):
        unpack_state(state, vehicle, TICK + 1)
    header[16:24] = struct.pack("<q", vehicle + 1)
    with pytest.raises(MessageError, match="the header names"):
        unpack_state(bytes(header), vehicle + 1, TICK)


def set_record_field(state: bytes, field: str, value: int) -> bytes:
    """Return a state with another value in an int32 field of its record."""
    at = RECORD_AT + int((VEHICLE.fields or {})[field][1])
    return state[:at] + struct.pack("<i", value) + state[at + 4 :]


def test_an_unknown_status_and_a_foreign_agent_are_refused() -> None:
    state, vehicle = make_state()
    with pytest.raises(MessageError, match="unknown transfer status 7"):
        unpack_state(set_record_field(state, "transfer", 7), vehicle, TICK)
    with pytest.raises(MessageError, match=f"agent {AGENTS}, but there are {AGENTS}"):
        unpack_state(set_record_field(state, "agent", AGENTS), vehicle, TICK)
    with pytest.raises(MessageError, match="control_latency_ticks and sensors"):
        unpack_state(set_record_field(state, "agent", -1), vehicle, TICK)


def test_another_record_or_environment_is_refused() -> None:
    state, vehicle = make_state()
    renamed = np.dtype([(name if name != "lane_stood" else "recall", kind)
                        for name, kind in VEHICLE.descr])  # fmt: skip
    codec, rows, _, _ = arrays(renamed)
    assert codec.schema != arrays()[0].schema
    with pytest.raises(MessageError, match="the same version of cavmarl"):
        codec.unpack(state, vehicle, TICK, rows, 0, 0)
    _, rows, commands, frames = arrays()
    for codec in (
        TransferCodec(VEHICLE, commands[:, :, 1:], frames),
        TransferCodec(VEHICLE, commands, frames[:, :, 1:]),
    ):
        assert codec.schema != arrays()[0].schema
        with pytest.raises(MessageError, match="of frames, but"):
            codec.unpack(state, vehicle, TICK, rows, 0, 0)
    padded = np.dtype([("id", "i8"), ("agent", "i4"), ("tick", "i8")], align=True)
    with pytest.raises(MessageError, match="padding"):
        TransferCodec(padded, commands, frames)


def test_a_refused_state_changes_no_row() -> None:
    state, vehicle = make_state()
    codec, rows, commands, frames = arrays()
    for wrong in (
        state[:-1],
        set_record_field(state, "transfer", 7),
        set_record_field(state, "agent", 9),
    ):
        with pytest.raises(MessageError):
            codec.unpack(wrong, vehicle, TICK, rows, 0, 0)
    for array in (rows, commands, frames):
        assert (array.view(np.uint8) == SCRIBBLE).all()


def test_states_work_in_worlds_without_agents() -> None:
    rows = arrays()[1]
    rows["agent"], rows["transfer"] = -1, 0
    nobody = TransferCodec(VEHICLE, np.zeros((2, 0, 1, 2)), np.zeros((2, 0, 0), dtype=np.float32))
    state = nobody.pack(rows, 0, 0, TICK)
    header = nobody.header(state)
    assert (header.record, header.commands, header.frames) == (VEHICLE.itemsize, 0, 0)
    nobody.unpack(state, header.vehicle, TICK, rows, 0, 1)


# Versions


def golden() -> dict[str, Any]:
    content: dict[str, Any] = json.loads(GOLDEN.read_text(encoding="utf-8"))
    return content


def test_a_state_of_version_one_is_read() -> None:
    """Read a golden file, which states the layout of its record."""
    if os.environ.get("CAVMARL_REWRITE"):
        state, vehicle = make_state()
        content = {
            "version": [RECORD_VERSION, 0],
            "vehicle": vehicle,
            "tick": TICK,
            "fields": VEHICLE.descr,
            "state": state.hex(),
        }
        GOLDEN.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    content = golden()
    record = np.dtype([(name, kind) for name, kind in content["fields"]])
    codec, rows, commands, frames = arrays(record)
    state = bytes.fromhex(content["state"])
    header = codec.header(state)
    assert [header.major, header.minor] == content["version"]
    codec.unpack(state, content["vehicle"], content["tick"], rows, 0, 0)
    _, expected, their_commands, their_frames = fill_row(record, 1)
    assert rows[0, 0] == expected[1, 2]
    np.testing.assert_array_equal(commands[0, 1], their_commands[1, 1])
    np.testing.assert_array_equal(frames[0, 1], their_frames[1, 1])


def test_a_changed_record_needs_another_version() -> None:
    record = np.dtype([(name, kind) for name, kind in golden()["fields"]])
    same = layout_text(VEHICLE) == layout_text(record)
    assert same == (golden()["version"][0] == RECORD_VERSION), (
        "VEHICLE has changed: raise RECORD_VERSION, and keep a golden file of the new version"
    )


@pytest.mark.parametrize(("minor", "more"), [(0, b""), (1, b""), (7, b"what a newer one adds")])
def test_every_minor_version_is_read(minor: int, more: bytes) -> None:
    state, vehicle = make_state()
    newer = state[:6] + struct.pack("<H", minor) + state[8:] + more
    assert unpack_state(newer, vehicle, TICK) == unpack_state(state, vehicle, TICK)


# The contract


def test_every_field_belongs_to_one_group() -> None:
    assert sorted(sum(GROUPS.values(), ())) == sorted(VEHICLE.names or ())


def test_the_page_describes_the_content_of_a_state() -> None:
    apart = {
        "control and route": "commands that wait for `clock.control_latency_ticks`",
        "agent logic": "the frames that the next observation repeats (`sensors.stack`)",
    }
    rows = [
        (group, ", ".join(f"`{name}`" for name in names), apart.get(group, ""))
        for group, names in GROUPS.items()
    ]
    header = ("group", "fields of the record", "other data")
    check_block(ROOT / "docs/explanation/ownership.md", "state", table(header, rows))
