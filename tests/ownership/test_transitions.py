"""The transition table is complete, and all other transitions are errors."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import pytest

from cavmarl.core.errors import ProtocolError
from cavmarl.ownership.endpoint import Endpoint
from cavmarl.ownership.messages import In, Out, Removed, Spawn
from cavmarl.ownership.transitions import TABLE, Event, Party, State, after, mermaid
from tests.ownership.bench import Bench

BEGINNINGS = {
    Party.VEHICLE: State.UNKNOWN,
    Party.ZONE: State.UNHOSTED,
    Party.ROW: State.NONE,
    Party.REPLICA: State.EMPTY,
}


def test_transitions_outside_of_the_table_raise() -> None:
    for party, state, event in product(Party, State, Event):
        if (party, state, event) in TABLE:
            assert after(party, state, event) is TABLE[party, state, event]
            continue
        with pytest.raises(ProtocolError, match=f"{event} of {party}, which is {state}"):
            after(party, state, event)


def test_a_host_cannot_receive_its_own_vehicles_or_release_other_vehicles() -> None:
    bench = Bench()
    bench.tick(births=[(7, 0), (8, 1)])
    step = bench.begin()[0]
    again = In(7, 1, True, bytes(16), b"state")
    for wrong in (
        replace(step, enter=(again,)),
        replace(step, leave=(Out(8, 0),)),
        replace(step, spawn=(Spawn(7, b"state"),)),
    ):
        host = Endpoint(bench.directory.hosting(0), bench.limits)
        with pytest.raises(ProtocolError, match="a vehicle's row"):
            host.on_message(wrong)
    host = Endpoint(bench.directory.hosting(0), bench.limits)
    host.on_message(step)
    with pytest.raises(ProtocolError, match="REMOVE of a vehicle's row"):
        host.complete(0, [Removed(8, 0)])
    with pytest.raises(ProtocolError, match="zone 0 on its way to tick 2"):
        Endpoint(replace(bench.directory.hosting(0), owned={}), bench.limits).on_message(step)


@pytest.mark.parametrize("party", Party)
def test_every_state_can_be_reached_from_the_initial_state(party: Party) -> None:
    reached = {BEGINNINGS[party]}
    for _ in State:
        reached |= {to for (whose, at, _), to in TABLE.items() if whose is party and at in reached}
    mentioned = {at for (whose, at, _) in TABLE if whose is party}
    assert mentioned <= reached
    assert len(reached) >= 2


def test_only_the_state_removed_is_final() -> None:
    left = {(whose, at) for (whose, at, _) in TABLE}
    reached = {(whose, to) for (whose, _, _), to in TABLE.items()}
    assert reached - left == {(Party.VEHICLE, State.REMOVED)}


@pytest.mark.parametrize("party", Party)
def test_the_diagram_has_every_transition(party: Party) -> None:
    lines = mermaid(party).splitlines()
    assert lines[0] == "stateDiagram-v2"
    assert len(lines) == 1 + sum(whose is party for whose, _, _ in TABLE)
