"""A forged state is refused with a typed error and does not change the worlds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl import CavVectorEnv
from cavmarl.core.errors import ConfigError, MessageError
from cavmarl.core.records.codes import DRIVER_LEARNED
from cavmarl.core.records.external_records import EXTERNAL
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.handoff.coordinator.saved_ownership import SavedOwnership
from cavmarl.parallel.state.world_bytes import from_bytes, to_bytes
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.signals.kernels import lane_history as lanes
from cavmarl.traffic.departure_queue import DEPARTURE
from tests.support.actuated import actuated_grid
from tests.support.forged_states import MANY, MOST, ROW, WAITING
from tests.support.replayed import BUSY
from tests.support.rerouting import CARS, DEVICE, FLOW, make_map, write_demand
from tests.support.signal_worlds import common_of_worlds
from tests.support.vec_runs import Make

Array = NDArray[Any]
State: TypeAlias = list[Array]
Forge = Callable[[State], None]

LATER = {
    "tick": (MANY,),
    "departed": (MANY,),
    "last_change": (MANY,),
}  # values later than the tick of the world


def _busy(make: Make, **more: Any) -> CavVectorEnv:
    vec = make("grid4x4", num_envs=2, zones=2, overrides=dict(BUSY), **more)
    vec.reset(seed=1)
    for _ in range(12):
        vec.step(vec.suggest_actions())
    return vec


def _worlds(vec: CavVectorEnv) -> LocalWorlds:
    assert isinstance(vec.worlds, LocalWorlds)
    return vec.worlds


def _check_refusal(vec: CavVectorEnv, forge: Forge) -> None:
    """Check that the worlds refuse their present state after a change by `forge`."""
    worlds = _worlds(vec)
    before = _forged(worlds, lambda state: None)
    forged = _forged(worlds, forge)
    with pytest.raises(ConfigError, match="state"):
        worlds.load(forged)
    assert _same(worlds.save(), before)


def _forged(worlds: LocalWorlds, forge: Forge) -> State:
    forged = [array.copy() for array in worlds.save()]
    forge(forged)
    return forged


def _same(one: State, other: State) -> bool:
    return all(_content(a) == _content(b) for a, b in zip(one, other, strict=True))


def _content(array: Array) -> list[bytes]:
    """Return the bytes of each field of a record array, without padding."""
    names = array.dtype.names
    return [array.tobytes()] if names is None else [array[name].tobytes() for name in names]


def _index(state: State, dtype: np.dtype[Any], last: bool = False) -> int:
    found = [n for n, array in enumerate(state) if array.dtype == dtype and array.size]
    return found[-1 if last else 0]


def test_rows_with_an_index_out_of_range_are_refused(make: Make) -> None:
    vec = _busy(make)
    for name, values in (ROW | LATER).items():
        for value in values:

            def forge(state: State, name: str = name, value: float = value) -> None:
                state[_index(state, VEHICLE, last=True)][name][-1] = value

            _check_refusal(vec, forge)


def test_rows_whose_way_plus_lane_overflows_are_refused(make: Make) -> None:
    vec = _busy(make)
    rows = vec.network.edges[~vec.network.edges["internal"]]
    for edge in rows[:3]:
        lane = int(edge["first_lane"])

        def forge(state: State, lane: int = lane) -> None:
            row = state[_index(state, VEHICLE, last=True)]
            row["lane"][-1], row["way"][-1] = lane, MOST - lane

        _check_refusal(vec, forge)


def test_waiting_vehicles_with_an_index_out_of_range_are_refused(make: Make) -> None:
    vec = _busy(make)
    worlds = _worlds(vec)
    while not (worlds.simulation.departures.num_queue > 0).any():
        vec.step(vec.suggest_actions())
    world = int(np.argmax(worlds.simulation.departures.num_queue > 0))
    for name, values in WAITING.items():
        for value in values:

            def forge(state: State, name: str = name, value: float = value) -> None:
                state[_index(state, DEPARTURE)][name][world, 0] = value

            _check_refusal(vec, forge)


def test_states_with_arrays_of_other_shapes_or_types_are_refused(make: Make) -> None:
    vec = _busy(make)
    count = len(_worlds(vec).save())
    for n in range(count):

        def shorten(state: State, n: int = n) -> None:
            state[n] = np.zeros((0, *state[n].shape[1:]), dtype=state[n].dtype)

        def retype(state: State, n: int = n) -> None:
            state[n] = np.zeros(state[n].shape, dtype=np.complex128)

        if n < count - 4:  # a zone may have no vehicles
            _check_refusal(vec, shorten)
        if n > 3:
            _check_refusal(vec, retype)
    _check_refusal(vec, lambda state: state.append(np.zeros(1)))
    _check_refusal(vec, State.clear)
    _check_refusal(vec, lambda state: state.__delitem__(-1))


def test_two_vehicles_with_one_id_are_refused(make: Make) -> None:
    def twice(name: str) -> Forge:
        def forge(state: State) -> None:
            rows = state[_index(state, VEHICLE, last=True)]
            rows[name][:2] = rows[name][-1]
            rows["driver"][:2], rows["goal"][:2] = rows["driver"][-1], rows["goal"][-1]

        return forge

    vec = _busy(make)
    _check_refusal(vec, twice("id"))
    worlds = _worlds(vec)
    while not (worlds.simulation.departures.num_queue > 0).any():
        vec.step(vec.suggest_actions())
    world = int(np.argmax(worlds.simulation.departures.num_queue > 0))
    driving = int(worlds.simulation.vehicles(world)["id"][0])

    def enters_twice(state: State) -> None:
        state[_index(state, DEPARTURE)]["id"][world, 0] = driving

    _check_refusal(vec, enters_twice)
    agent = int(worlds.simulation.vehicles(world)["agent"].max())

    def drives_twice(state: State) -> None:
        state[_index(state, DEPARTURE)]["agent"][world, 0] = agent

    _check_refusal(vec, drives_twice)


def test_invalid_states_of_overridden_signals_are_refused(make: Make) -> None:
    vec = make("town", num_envs=2, zones=2, overrides={"signals.overrides": 3})
    vec.reset(seed=2)
    links = vec.network.links[vec.network.links["signal"] >= 0]
    name = vec.network.signal_ids[links["signal"][0]]
    vec.signal_overrides.show(name, int(links["signal_index"][0]), "r", world=1)
    vec.step(vec.suggest_actions())
    worlds = _worlds(vec)
    phases = worlds.simulation.shards[0].worlds.signal_phase
    place = next(n for n, saved in enumerate(worlds.save()) if saved is phases)
    first = len(vec.network.signals)
    plain = first + int(np.flatnonzero(vec.network.links["signal"] < 0)[0])
    shown = int(np.flatnonzero(phases[1, first:])[0]) + first
    for column, value in ((shown, 10), (shown, -1), (plain, 1)):

        def forge(state: State, column: int = column, value: int = value) -> None:
            state[place][1, column] = value

        _check_refusal(vec, forge)


def test_invalid_counts_signals_and_owners_are_refused(make: Make, tmp_path: Path) -> None:
    vec = make(str(actuated_grid(tmp_path)), num_envs=2, zones=2, agents=3, background=30)
    vec.reset(seed=2)
    for _ in range(20):
        vec.step(vec.suggest_actions())
    worlds = _worlds(vec)
    simulation = worlds.simulation
    common = {
        "ticks": -1,
        "signal_phase": MANY,
        "pending": np.nan,
        "detected_s": np.nan,
        "cues": -2,
    }
    departures = {"next_order": 1, "num_queue": MANY, "next_id": 0, "num_entered": -1, "counts": -1}
    for source, values in (
        (simulation.shards[0].worlds, common),
        (simulation.departures, departures),
    ):
        for name, value in values.items():
            array = getattr(source, name)
            if not array.size:
                continue
            place = next(n for n, saved in enumerate(worlds.save()) if saved is array)

            def forge(state: State, place: int = place, value: float = value) -> None:
                state[place][...] = value

            _check_refusal(vec, forge)
    controllers = simulation.shards[0].worlds.controllers
    place = next(n for n, saved in enumerate(worlds.save()) if saved is controllers)
    assert controllers.size
    _check_refusal(vec, lambda state: state[place]["phase"].fill(MANY))
    now_ms = int(simulation.ticks()[0] * simulation.config.clock.sim_dt_s * 1e3)
    # If such a state were accepted, the next tick would run all overdue checks of the signal
    # controllers one by one.
    for name, value in (("next_ms", 0), ("next_ms", 1 << 40), ("since_ms", now_ms + 9_000)):

        def mistime(state: State, name: str = name, value: int = value) -> None:
            state[place][name] = value

        _check_refusal(vec, mistime)
    ticks = next(
        n for n, array in enumerate(worlds.save()) if array is simulation.shards[0].worlds.ticks
    )
    _check_refusal(vec, lambda state: state[ticks].fill(1 << 62))
    words = len(worlds.save()) - 2 * 2 - 2
    rng = np.random.default_rng(0)
    size = worlds.save()[words].shape[1]
    for n in range(9):  # the first nine words are the lengths of the parts of the saved ownership

        def lengthen(state: State, n: int = n) -> None:
            state[words][0, n] = MANY

        def deny(state: State, n: int = n) -> None:
            state[words][0, n] = -1

        _check_refusal(vec, lengthen)
        _check_refusal(vec, deny)
    for _ in range(200):  # each random change is refused or does not affect the vehicles
        state = [array.copy() for array in worlds.save()]
        state[words][0, rng.integers(size)] = rng.integers(-MANY, MANY)
        hashes = [vec.state_hash(w) for w in range(2)]
        before = [array.copy() for array in worlds.save()]
        try:
            worlds.load(state)
        except ConfigError:
            assert _same(worlds.save(), before)
        assert [vec.state_hash(w) for w in range(2)] == hashes
        worlds.load(before)


def _with_demand(make: Make, tmp_path: Path, **more: Any) -> CavVectorEnv:
    """Return two worlds with rerouted vehicles after 400 steps."""
    files = write_demand(tmp_path, CARS.format(device=DEVICE) + FLOW)
    overrides = {
        "traffic.demand": [str(path) for path in files],
        "clock.sim_dt_s": 0.2,
        "clock.ctrl_dt_s": 1.0,
        "horizon_s": 600.0,
        "population.mode": "respawn",
        **more,
    }
    vec = make(str(make_map(tmp_path)), num_envs=2, agents=1, background=0, overrides=overrides)
    vec.reset(seed=1)
    for step in range(400):
        vec.step(vec.suggest_actions())
        if step % 40 == 39:
            vec.load_state(vec.save_state())
    assert vec.traffic_stats()["rerouted"] > 0
    return vec


def test_routes_of_rerouted_vehicles_out_of_range_are_refused(make: Make, tmp_path: Path) -> None:
    vec = _with_demand(make, tmp_path)
    worlds = _worlds(vec)
    steps = next(n for n, a in enumerate(worlds.save()) if "turnarounds" in (a.dtype.names or ()))
    for name, value in (("next", MANY), ("next", -2), ("link", MANY), ("link", -2)):

        def forge(state: State, name: str = name, value: int = value) -> None:
            state[steps][name] = value

        _check_refusal(vec, forge)

    def circle(state: State) -> None:
        state[steps]["next"] = state[steps]["shift"] = 0

    with pytest.raises(ConfigError, match="does not end"):
        worlds.load(_forged(worlds, circle))


def test_external_vehicles_that_do_not_match_their_slots_are_refused(make: Make) -> None:
    vec = make("grid4x4", num_envs=2, zones=2, overrides={"population.external": 3})
    vec.reset(seed=1)
    min_x, min_y, _, _ = vec.network.extent_m
    for k in range(2):
        vec.external.spawn(min_x + 50.0, min_y + 20.0 * k, 0.0, world=1)
    vec.step(vec.suggest_actions())
    ids = vec.external.ids(world=1)
    arrays = _worlds(vec).save()
    (at,) = [n for n, array in enumerate(arrays) if _content(array) == _content(ids_of(vec))]
    for value in (-2, MANY, int(ids[1])):
        _check_refusal(vec, with_id(at, value))
    # Slot and row agree, but the world may give this id to another vehicle.
    for other in (MANY, int(ids[0]) + 1):

        def renumber(state: State, other: int = other) -> None:
            state[at][state[at] == ids[0]] = other
            for rows in state:
                if rows.dtype == VEHICLE:
                    rows["id"][rows["id"] == ids[0]] = other

        _check_refusal(vec, renumber)
    for name, wrong in (
        ("kind", 0.0), ("kind", 3.0), ("x", np.nan), ("vtype", 9.5), ("length", 50.0),
    ):  # fmt: skip
        _check_refusal(vec, with_command(at - 1, name, wrong))
    for name, value in (("order", 2), ("order", 9), ("order", -1), ("way", 0), ("goal", 0)):

        def forge(state: State, name: str = name, value: int = value) -> None:
            for rows in state:
                if rows.dtype == VEHICLE:
                    rows[name][rows["id"] == ids[0]] = value

        _check_refusal(vec, forge)

    # The state of one node has only the vehicles of its own zones.
    part = _forged(_worlds(vec), lambda state: None)
    for n, rows in enumerate(part):
        if rows.dtype == VEHICLE and np.isin(ids[:2], rows["id"]).any():
            part[n] = rows[:0]
    _worlds(vec).check(part, is_whole=False)
    with pytest.raises(ConfigError, match="external vehicles and their slots do not match"):
        _worlds(vec).check(part)


def test_signal_states_with_invalid_greens_times_or_counts_are_refused(make: Make) -> None:
    keys = {"signals.agents": "all", "signals.sensing": "loops"}
    vec = make("grid4x4", num_envs=2, zones=2, overrides=keys)
    vec.reset(seed=1)
    for _ in range(12):
        vec.step(vec.suggest_actions())
    outputs = _worlds(vec).simulation.signals.outputs
    arrays = _worlds(vec).save()

    def place(wanted: Array) -> int:
        (at,) = [n for n, array in enumerate(arrays) if _content(array) == _content(wanted)]
        return at

    found = outputs.states, outputs.observations, outputs.counts, outputs.history
    at, seen, counts, history = map(place, found)
    for column, value in ((0, -1), (0, 2), (1, 2), (1, MANY), (2, -1), (2, 1 << 41), (3, -1)):
        _check_refusal(vec, with_value(at, (1, 3, column), value))
    _check_refusal(vec, with_value(at + 1, (0, 2), -1))  # sums of waiting times
    for wrong in (-0.5, 1.5, np.nan):
        _check_refusal(vec, with_value(seen, (0, 0, 0), wrong))
    _check_refusal(vec, with_value(counts, (0, 0, 0), -1))
    for column, least in ((lanes.RED_TICKS, 0), (lanes.PASSED, 0), (lanes.FLOW, -1)):
        _check_refusal(vec, with_value(history, (1, 2, column), least - 1))
    _check_refusal(vec, with_value(counts + 2, (0, 0, 0, 0), -1))  # state of induction loops
    _check_refusal(vec, with_value(place(outputs.loops), (1, 3, 1, 2), 1 << 41))
    controllers = place(common_of_worlds(_worlds(vec).simulation).controllers)

    def due(state: State) -> None:
        state[controllers]["next_ms"][0, 0] = 5000

    _check_refusal(vec, due)


def with_value(at: int, place: tuple[int, ...], value: float) -> Forge:
    def forge(state: State) -> None:
        state[at][place] = value

    return forge


def ids_of(vec: CavVectorEnv) -> Array:
    return _worlds(vec).simulation.external.ids


def with_id(at: int, value: int) -> Forge:
    def forge(state: State) -> None:
        state[at][1, 0] = value

    return forge


def with_command(at: int, name: str, value: float) -> Forge:
    def forge(state: State) -> None:
        state[at].view(EXTERNAL)[name][1, 0] = value

    return forge


def test_vehicles_of_the_demand_file_with_a_learned_driver_are_refused(
    make: Make, tmp_path: Path
) -> None:
    vec = _with_demand(make, tmp_path, **{"traffic.model": "zoo:ring22_ippo"})
    types = _worlds(vec).simulation.shards[0].travel.types
    network = int(np.argmax(types["network"]))
    assert types["network"][network] == 1

    def forge(state: State) -> None:
        row = state[_index(state, VEHICLE, last=True)]
        assert row["order"][-1] >= 0
        row["driver"][-1], row["vtype"][-1] = DRIVER_LEARNED, network

    with pytest.raises(ConfigError, match="does not fit its driver, order"):
        _worlds(vec).load(_forged(_worlds(vec), forge))


def test_counts_and_indices_of_messages_out_of_range_are_refused(make: Make) -> None:
    overrides = {"v2x.enabled": True}
    vec = make("grid4x4", agents=4, background=20, overrides=overrides)
    vec.reset(seed=1)
    for _ in range(5):
        vec.step(vec.suggest_actions())
    worlds = _worlds(vec)
    mail = worlds.simulation.messages.mail
    saved = {id(array): n for n, array in enumerate(worlds.save())}
    for array in (mail.num_packets, mail.num_reports, mail.num_last):
        place = saved.get(id(array))
        if place is not None:
            _check_refusal(vec, lambda state, place=place: state[place].fill(-1))
            _check_refusal(vec, lambda state, place=place: state[place].fill(MANY))
    if id(mail.packets) in saved:
        place = saved[id(mail.packets)]
        _check_refusal(vec, lambda state: state[place]["first"].fill(MANY))


def test_forged_states_of_single_worlds_are_refused(make: Make) -> None:
    vec = _busy(make)
    worlds = _worlds(vec)
    saved, hashes = worlds.save_worlds(), [vec.state_hash(w) for w in range(2)]
    like = worlds.share_of(0)
    arrays = from_bytes(saved[0], [*like[:-2], like[-1]])
    for n, array in enumerate(arrays):
        shape = (2, *array.shape[1:])
        for other in (np.zeros(shape, array.dtype), np.zeros_like(array[:0])):
            if n == len(arrays) - 1 or other.shape == array.shape:
                continue
            forged = [*arrays[:n], other, *arrays[n + 1 :]]
            assert worlds.refusal([to_bytes(forged), saved[1]]).startswith("the state ")
            with pytest.raises(ConfigError, match="state"):
                worlds.load_worlds([to_bytes(forged), saved[1]])
    assert [vec.state_hash(w) for w in range(2)] == hashes


def test_forged_rows_of_vehicles_that_change_their_zone_are_refused(make: Make) -> None:
    simulation = _worlds(_busy(make)).simulation
    codec, rows = simulation.division.codec, simulation.shards[0].worlds.rows
    tick = int(simulation.ticks()[0])
    vehicle = int(rows["id"][0, 0])
    for name, values in ROW.items():
        for value in values:
            if name in ("id", "order", "transfer", "agent", "owner"):
                continue
            forged = rows[0, :1].copy().reshape(1, 1)
            forged[name] = value
            with pytest.raises(MessageError):
                codec.unpack(codec.pack(forged, 0, 0, tick), vehicle, tick, rows.copy(), 0, 0)


def test_a_state_that_repeats_a_departure_is_refused(make: Make, tmp_path: Path) -> None:
    vec = _with_demand(make, tmp_path)
    worlds = _worlds(vec)
    place = next(
        n
        for n, array in enumerate(worlds.save())
        if array is worlds.simulation.departures.next_order
    )
    assert (worlds.save()[place] > 3).all()
    _check_refusal(vec, lambda state: state[place].fill(1))


@pytest.mark.parametrize("at", [b"'shape': (2,", b"'descr': '<i8'", b"'fortran_order': False"])
def test_headers_that_do_not_match_their_bytes_are_refused(at: bytes) -> None:
    like = [np.arange(8).reshape(2, 4)]
    content = to_bytes(like)
    assert at in content
    changes = (
        b"'shape': (9" + b"9" * 13 + b",",
        b"'shape': ((((2,",
        b"'descr': '|O8'",
        b"'descr': '<c8'",
        b"'fortran_order': True ",
    )
    for change in changes:
        if change[:9] == at[:9]:
            with pytest.raises(ConfigError, match="other arrays"):
                from_bytes(content.replace(at, change), like)


def test_flags_that_are_neither_true_nor_false_are_refused() -> None:
    like = [np.ones(5, dtype=np.bool_)]
    content = bytearray(to_bytes(like))
    assert from_bytes(content, like)[0].all()
    content[-1] = 7
    with pytest.raises(ConfigError, match="neither true nor false"):
        from_bytes(content, like)


def test_a_clock_that_is_far_ahead_is_refused(make: Make) -> None:
    vec = _busy(make)
    worlds = _worlds(vec)
    assert not worlds.simulation.shards[0].worlds.controllers.size, (
        "the state of a controller would be refused first"
    )
    ticks = next(
        n
        for n, array in enumerate(worlds.save())
        if array is worlds.simulation.shards[0].worlds.ticks
    )
    _check_refusal(vec, lambda state: state[ticks].fill(1 << 62))


def test_a_saved_ownership_with_a_wrong_number_of_vehicles_is_refused(make: Make) -> None:
    vec = _busy(make)
    worlds = _worlds(vec)
    place = len(worlds.save()) - 2 * 2 - 2
    before = SavedOwnership.unpack(worlds.save()[place][0])
    assert before is not None
    assert before.numbers.owned > 40
    forged = before._replace(numbers=before.numbers._replace(owned=2)).pack()

    def disown(state: State) -> None:
        state[place][0, : len(forged)] = forged

    _check_refusal(vec, disown)
