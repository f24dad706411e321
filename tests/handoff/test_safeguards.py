"""AT8 on whole worlds: without a remedy of the protocol somebody can tell.

Those that only a certain order of messages needs, or that another one stands behind, have their
scenario in tests/ownership/scenarios.py, as all others have, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from cavmarl import CavVectorEnv, make_vec
from cavmarl.core.errors import CavmarlError, ProtocolError
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.handoff.coordinator.coordinator_setup import make_coordinators
from cavmarl.handoff.fault_injection.fault_plan import Crash, Faults
from cavmarl.handoff.fault_injection.message_coordinator import MessageCoordinator
from cavmarl.ownership.endpoint import Endpoint
from cavmarl.ownership.messages import Commit, Done, Message, Offer, Record
from cavmarl.ownership.replicas import Replicas
from cavmarl.ownership.safeguards import ALL_ON
from cavmarl.ownership.transport import Network, Rates
from cavmarl.shards.vehicle_codec import _HEADER
from tests.support.faulted import BUSY, NOISE, Recorded, follow, record, replay

STEPS = 20
ZONES = 4
LIFETIME = 16
SPEED_BYTE = np.dtype(VEHICLE).fields["speed"][1] + 5  # type: ignore[index]
LATE = {kind: replace(rates, delay=0.5, duplicate=0.5, longest_delay=64)
        for kind, rates in NOISE.items()}  # fmt: skip
# What is not lost here goes through the network all the same, and not straight.
MAILED = Faults(messages={"Nack": Rates(drop=0.01)})

NEEDED: dict[str, Faults] = {
    "one_step_lease": Faults(),
    "double_buffer": Faults(crashes=(Crash(9, "all done"),)),
    "log_before_send": Faults(
        messages={"Ack": Rates(drop=0.5)},
        crashes=tuple(Crash(tick, "STEP sent") for tick in range(3, 30)),
    ),
    "reattach": Faults(
        crashes=tuple(
            Crash(tick, "STEP arrives", zone) for tick in range(3, 30) for zone in range(ZONES)
        )
    ),
    "replica_slot": Faults(messages={"Prepare": Rates(duplicate=1.0, longest_delay=40)}),
    "done_incarnation": Faults(
        messages={"Done": Rates(delay=0.7, duplicate=0.5, longest_delay=20)},
        crashes=tuple(
            Crash(tick, "commit", zone, lives_on=True)
            for tick in range(3, 30)
            for zone in range(ZONES)
        ),
    ),
    "step_tick": Faults(messages={"Step": Rates(duplicate=1.0, longest_delay=64)}),
    "done_tick": Faults(messages={"Done": Rates(duplicate=1.0, longest_delay=20)}),
    "answer_again": Faults(messages={"Done": Rates(drop=0.5)}),
    "tick_never_resets": Faults(messages=LATE),
    "deadline": Faults(messages={"Ack": Rates(drop=1.0)}),
}


@pytest.fixture(scope="module")
def busy() -> Recorded:
    return record("grid4x4", {**BUSY, "horizon_s": 4.8}, STEPS)


Without = Callable[[str], None]


@pytest.fixture
def without(monkeypatch: pytest.MonkeyPatch) -> Without:
    """Takes a safeguard away from the worlds that are made next."""

    def take_away(name: str) -> None:
        partly = partial(make_coordinators, safeguards=replace(ALL_ON, **{name: False}))
        monkeypatch.setattr("cavmarl.engine.simulation.make_coordinators", partly)

    return take_away


@pytest.mark.parametrize("name", NEEDED)
def test_at08_without_a_safeguard_somebody_can_tell(
    busy: Recorded, name: str, without: Without
) -> None:
    without(name)
    with pytest.raises((AssertionError, CavmarlError, KeyError)):
        replay(busy, ZONES, NEEDED[name])


@pytest.mark.parametrize("name", NEEDED)
def test_at08_with_all_safeguards_nobody_can(busy: Recorded, name: str) -> None:
    replay(busy, ZONES, NEEDED[name])


def divided(run: Recorded) -> CavVectorEnv:
    """A world whose zones are told by messages, of which none is lost."""
    settings = {**run.settings, "zones.faults": Faults().to_json()}
    return make_vec(run.env, num_envs=1, zones=ZONES, overrides=settings)


# Harm that no plan of faults does: hosts that are broken, and not only dead.


def test_at08_a_state_that_is_damaged_in_memory_is_refused(
    busy: Recorded, monkeypatch: pytest.MonkeyPatch, without: Without
) -> None:
    prepare = Replicas.prepare

    def damaged(replicas: Replicas, offer: Offer, tick: int, schema: int) -> Any:
        state = bytearray(offer.state)
        state[_HEADER.size + SPEED_BYTE] ^= 0x10
        return prepare(replicas, offer._replace(state=bytes(state)), tick, schema)

    monkeypatch.setattr(Replicas, "prepare", damaged)
    vec = replay(busy, ZONES, MAILED)
    assert vec.simulation.transfers[0].counts["refused"] > 10
    without("state_digest")
    with pytest.raises((AssertionError, CavmarlError)):
        replay(busy, ZONES, MAILED)


def test_at08_a_host_that_keeps_an_older_state_is_sent_the_newer_one(
    busy: Recorded, monkeypatch: pytest.MonkeyPatch, without: Without
) -> None:
    prepare = Replicas.prepare

    def forgetful(replicas: Replicas, offer: Offer, tick: int, schema: int) -> Any:
        older = replicas.held.get(offer.vehicle)
        taken = prepare(replicas, offer, tick, schema)
        if older is not None:
            replicas.held[offer.vehicle] = older
        return taken

    monkeypatch.setattr(Replicas, "prepare", forgetful)
    replay(busy, ZONES, MAILED)
    without("exact_promotion")
    with pytest.raises((AssertionError, CavmarlError)):
        replay(busy, ZONES, MAILED)


def test_at08_a_host_that_counts_wrong_is_found_out(
    busy: Recorded, monkeypatch: pytest.MonkeyPatch, without: Without
) -> None:
    complete = Endpoint.complete

    def wrong(endpoint: Endpoint, *arguments: Any) -> Done:
        done = complete(endpoint, *arguments)
        owned = done.owned._replace(vehicles=done.owned.vehicles - 1)
        return replace(done, owned=owned) if done.tick == 7 and done.zone == 2 else done

    monkeypatch.setattr(Endpoint, "complete", wrong)
    with pytest.raises(ProtocolError, match="zone 2 at tick 7"):
        follow(busy, divided(busy))
    without("ledger")
    follow(busy, divided(busy))


class Heard:
    """A watcher that keeps the DONEs of a run."""

    def __init__(self) -> None:
        self.dones: dict[tuple[int, int], Done] = {}

    def logged(self, records: Iterable[Record]) -> None:
        pass

    def delivered(self, destination: int, message: Message) -> None:
        if isinstance(message, Done):
            self.dones[message.zone, message.tick] = message


class Crossed(Network):
    """Delivers what zones of another run have said before what those of this run say."""

    def __init__(self, heard: Heard) -> None:
        super().__init__()
        self._dones = heard.dones

    def send(self, messages: Iterable[Message]) -> None:
        for message in messages:
            if isinstance(message, Done):
                super().send([self._dones[message.zone, message.tick]])
            super().send([message])


def test_at08_what_zones_of_another_run_say_is_not_heard(
    busy: Recorded, monkeypatch: pytest.MonkeyPatch, without: Without
) -> None:
    heard = Heard()
    replay(busy, ZONES, Faults(), watchers=[heard])
    make = MessageCoordinator.__init__

    def crossed(coordinator: MessageCoordinator, *arguments: Any, **named: Any) -> None:
        make(coordinator, *arguments, **named)
        coordinator.post = Crossed(heard)

    monkeypatch.setattr(MessageCoordinator, "__init__", crossed)
    vec = replay(busy, ZONES, Faults())
    assert vec.simulation.coordinators[0].dropped()["Done", "run"] == 2 * STEPS * ZONES
    without("run_fence")
    with pytest.raises((AssertionError, CavmarlError)):
        replay(busy, ZONES, Faults())


class Left:
    """A watcher that knows who has left."""

    def __init__(self) -> None:
        self.vehicles: list[int] = []

    def logged(self, records: Iterable[Record]) -> None:
        for entry in records:
            if isinstance(entry, Commit):
                self.vehicles += [removed.vehicle for removed in entry.removed]

    def delivered(self, destination: int, message: Message) -> None:
        pass


def returning(busy: Recorded) -> None:
    """A run in which an id that has left is said to have come back."""
    vec, left = divided(busy), Left()
    coordinator = vec.simulation.coordinators[0]
    coordinator.watch(left)
    vec.reset(seed=busy.seed)
    for actions in busy.actions:
        if left.vehicles:
            coordinator.entered([(left.vehicles.pop(), 0)])
            vec.step(actions)
            return
        vec.step(actions)
    pytest.fail("nobody has left")


def test_at08_an_id_that_has_left_does_not_come_back(busy: Recorded, without: Without) -> None:
    with pytest.raises(ProtocolError, match="an episode uses an id once"):
        returning(busy)
    without("removed_is_final")
    with pytest.raises(ProtocolError):  # it is decided and logged, and then cannot be
        returning(busy)


def oldest_replica(vec: CavVectorEnv) -> int:
    """Ticks since a state that some zone keeps was refreshed, the most of all."""
    (coordinator,) = vec.simulation.coordinators
    held = [replica for endpoint in coordinator.endpoints.values()
            for replica in endpoint.replicas.held.values()]  # fmt: skip
    return max(coordinator.tick - replica.tick for replica in held)


def test_at08_states_of_vehicles_that_turned_away_do_not_stay(without: Without) -> None:
    run = record("grid4x4", {**BUSY, "zones.approach_ticks": 30}, 2 * STEPS)
    faults = Faults(messages={"Abort": Rates(drop=1.0)})
    assert oldest_replica(replay(run, 9, faults)) <= LIFETIME
    without("replica_lifetime")
    assert oldest_replica(replay(run, 9, faults)) > LIFETIME
