"""A vectorized environment resumes from saved bytes bit for bit, with any zones and workers."""

from __future__ import annotations

import hashlib
from io import BytesIO
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.core.errors import ActionError, ConfigError, EpisodeError
from cavmarl.core.records.external_records import EXTERNAL
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.parallel.state.world_bytes import to_bytes

WORLDS, HORIZON = 2, 15


def make(mode: str = "SameStep", num_envs: int = WORLDS, **arguments: Any) -> CavVectorEnv:
    return make_vec(
        "ring",
        num_envs=num_envs,
        agents=3,
        background=4,
        max_cycles=HORIZON,
        autoreset_mode=mode,
        **arguments,
    )


def drive(vec: CavVectorEnv, steps: range) -> list[bytes]:
    """Drive the steps, whose numbers are the seeds of the actions, and return all results."""
    found = []
    for step in steps:
        actions = np.random.default_rng(step).uniform(-1.0, 1.0, (vec.num_envs, vec.num_agents, 2))
        *results, infos = vec.step(actions.astype(np.float32))
        found += [array.tobytes() for array in (*results, *infos.values(), vec.state())]
    return [*found, *(vec.state_hash(world).encode() for world in range(vec.num_envs))]


@pytest.mark.parametrize(
    ("mode", "arguments"),
    [
        ("SameStep", {}),
        ("NextStep", {"zones": 2}),
        ("NextStep", {"zones": 2, "workers": 4}),
        ("SameStep", {"workers": 2, "overrides": {"workers.balance_steps": 3}}),
        ("NextStep", {"zones": 3, "nodes": 2}),
    ],
)
@pytest.mark.filterwarnings("ignore:workers = ")
def test_loaded_worlds_continue_bit_for_bit(mode: str, arguments: dict[str, Any]) -> None:
    before, middle, after = range(HORIZON + 4), range(20, 30), range(30, 50)
    whole = make(mode)
    whole.reset(seed=3)
    drive(whole, before)
    saved = whole.save_state()
    expected = drive(whole, middle), drive(whole, after)
    other = make(mode, **arguments)
    try:
        other.load_state(saved)
        found = drive(other, middle)
        again = other.save_state()
        assert (found, drive(other, after)) == expected
    finally:
        other.close()
    whole.load_state(again)
    assert drive(whole, after) == expected[1]


def test_invalid_saves_and_loads_are_refused() -> None:
    vec = make()
    with pytest.raises(EpisodeError, match=r"save_state\(\) before reset"):
        vec.save_state()
    vec.reset(seed=0)
    saved = vec.save_state()
    for other in (make(num_envs=3), make_vec("merge", num_envs=WORLDS, agents=3, background=4)):
        with pytest.raises(ConfigError, match="belongs to other worlds, or to another"):
            other.load_state(saved)
    for damaged in (saved[:-1], saved[:50] + b"x" + saved[51:], b""):
        with pytest.raises(ConfigError, match="the saved state is damaged"):
            vec.load_state(damaged)


def forged(vec: CavVectorEnv, saved: bytes, place: int, value: float, item: int = 0) -> bytes:
    """Return a saved state with one changed item in array `place`, and with a valid checksum."""
    arrays = [array.copy() for array in saved_arrays(vec, saved)]
    arrays[place].flat[item] = value
    content = to_bytes(arrays)
    return hashlib.sha256(content).digest() + content


def saved_arrays(vec: CavVectorEnv, saved: bytes) -> list[NDArray[Any]]:
    file, found = BytesIO(saved[32:]), []
    while file.tell() < len(saved) - 32:
        found.append(np.lib.format.read_array(file))
    return found


MASK, CAUSES, INSERTED, WAITING, USED, LAST, CLIPPED = range(7)
SIZES = -2


@pytest.mark.parametrize(
    ("place", "at", "value", "message"),
    [
        (CAUSES, 0, 3, "events are declared in worlds without messages"),
        (INSERTED, 0, 9.0, "an insertion has an unknown kind"),
        (WAITING, 0, -1, "the number of insertions is out of range"),
        (WAITING, 0, 3, "the number of insertions is out of range"),
        (WAITING, 0, 0, "an unused row of insertions is not empty"),
        (USED, 0, 99, "the number of insertions is out of range"),
        (LAST, 0, 1.5, "a last action is out of range"),
        (LAST, 0, np.nan, "a last action is out of range"),
        (CLIPPED, 0, -1, "a count of tolerated actions is negative"),
        (INSERTED, 1, 1e9, "an insertion is on a lane that does not exist"),
        (INSERTED, 1, 0.5, "an insertion is on a lane that does not exist"),
        (INSERTED, 2, -1.0, "an insertion is before the start or beyond the end of its lane"),
        (INSERTED, 2, np.nan, "an insertion is before the start or beyond the end of its lane"),
        (SIZES, 0, -1, "the state of a world has a negative size"),
    ],
)
def test_invalid_values_outside_of_the_simulation_are_refused(
    place: int, at: int, value: float, message: str
) -> None:
    vec = make(overrides={"population.insertions": 3})
    vec.reset(seed=0)
    lane = next(name for name in vec.network.lane_ids if not name.startswith(":"))
    vec.insert_vehicle(lane, 1.0)
    saved = vec.save_state()
    vec.load_state(saved)
    with pytest.raises(ConfigError, match=message):
        vec.load_state(forged(vec, saved, place, value, at))
    assert vec.save_state() == saved


EXTERNAL_COMMANDS, EXTERNAL_USED = 9, 10


def with_external(**arguments: Any) -> tuple[CavVectorEnv, bytes]:
    """Return worlds in which an external vehicle waits to enter, and their saved state."""
    vec = make(overrides={"population.external": 3}, **arguments)
    vec.reset(seed=0)
    min_x, min_y, _, _ = vec.network.extent_m
    assert vec.external.spawn(min_x, min_y, 0.0) == 0
    return vec, vec.save_state()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("kind", 7.0, "unknown kind"),
        ("x", np.nan, "invalid x"),
        ("speed", np.inf, "invalid speed"),
        ("vtype", 99.0, "unknown type"),
        ("length", 0.0, "has no size"),
        ("length", 90.0, "larger than all types"),
    ],
)
def test_invalid_waiting_commands_to_external_vehicles_are_refused(
    name: str, value: float, message: str
) -> None:
    vec, saved = with_external()
    item = (EXTERNAL.names or ()).index(name)
    with pytest.raises(ConfigError, match=message):
        vec.load_state(forged(vec, saved, EXTERNAL_COMMANDS, value, item))
    vec.load_state(saved)
    assert vec.save_state() == saved


def test_a_command_to_a_vehicle_that_does_not_exist_in_the_world_is_refused() -> None:
    vec, saved = with_external()
    vec.load_state(forged(vec, saved, EXTERNAL_USED, True, item=2))
    vec.external.drive(2, 1.0, 0.0)
    before = vec.state_hash(0)
    with pytest.raises(ActionError, match="external vehicle 2: it does not exist"):
        vec.step(vec.suggest_actions())
    assert vec.state_hash(0) == before
