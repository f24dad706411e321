"""The transition table is whole, and what it does not list is an error."""

from __future__ import annotations

from itertools import product

import pytest

from cavmarl.errors import TransitionError
from cavmarl.ownership.transitions import TABLE, Event, Party, State, after, mermaid

BEGINNINGS = {
    Party.VEHICLE: State.UNKNOWN,
    Party.ZONE: State.UNHOSTED,
    Party.ROW: State.NONE,
    Party.REPLICA: State.EMPTY,
}


def test_what_is_not_listed_does_not_happen() -> None:
    for party, state, event in product(Party, State, Event):
        if (party, state, event) in TABLE:
            assert after(party, state, event) is TABLE[party, state, event]
            continue
        with pytest.raises(TransitionError, match=f"{event} of {party}, which is {state}"):
            after(party, state, event)


@pytest.mark.parametrize("party", Party)
def test_every_state_is_reached_from_the_beginning(party: Party) -> None:
    reached = {BEGINNINGS[party]}
    for _ in State:
        reached |= {to for (whose, at, _), to in TABLE.items() if whose is party and at in reached}
    mentioned = {at for (whose, at, _) in TABLE if whose is party}
    assert mentioned <= reached
    assert len(reached) >= 2


def test_only_removed_is_final() -> None:
    left = {(whose, at) for (whose, at, _) in TABLE}
    reached = {(whose, to) for (whose, _, _), to in TABLE.items()}
    assert reached - left == {(Party.VEHICLE, State.REMOVED)}


@pytest.mark.parametrize("party", Party)
def test_the_diagram_has_every_transition(party: Party) -> None:
    lines = mermaid(party).splitlines()
    assert lines[0] == "stateDiagram-v2"
    assert len(lines) == 1 + sum(whose is party for whose, _, _ in TABLE)
