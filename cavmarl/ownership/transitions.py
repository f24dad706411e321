"""The state machines of the protocol. `TABLE` has all transitions.

Rule 1: a transition that is not in the table is an error: `after` raises.
Rule 2: the receiver drops and counts late messages before it looks up a transition.

A host has two independent slots for a vehicle: its ROW, which the host may advance while it is
AUTHORITATIVE, and its REPLICA, which is never advanced.
"""

from __future__ import annotations

from enum import StrEnum

from cavmarl.core.errors import ProtocolError


class _Word(StrEnum):
    # The hash of Enum is a Python function, which is too slow for the lookups of each tick.
    __hash__ = str.__hash__


class Party(_Word):
    """The kinds of state machines."""

    VEHICLE = "a vehicle, at the coordinator"
    ZONE = "a zone, at the coordinator"
    ROW = "a vehicle's row, at a zone host"
    REPLICA = "a vehicle's replica, at a zone host"


class State(_Word):
    """The states of all parties."""

    UNKNOWN = "UNKNOWN"
    OWNED = "OWNED"
    SWITCHING = "SWITCHING"
    REMOVED = "REMOVED"
    UNHOSTED = "UNHOSTED"
    HOSTED = "HOSTED"
    FENCED = "FENCED"
    NONE = "NONE"
    AUTHORITATIVE = "AUTHORITATIVE"
    RETAINED = "RETAINED"
    EMPTY = "EMPTY"
    PREPARED = "PREPARED"


class Event(_Word):
    """The events that cause transitions."""

    SPAWN = "SPAWN"
    SWITCH = "SWITCH"
    COMMIT = "COMMIT"
    REMOVE = "REMOVE"
    HOST = "HOST"
    FENCE = "FENCE"
    LOAD = "LOAD"
    IN = "IN"
    OUT = "OUT"
    RELEASE = "RELEASE"
    PREPARE = "PREPARE"
    ABORT = "ABORT"
    EXPIRE = "EXPIRE"


P, S, E = Party, State, Event

# fmt: off
TABLE: dict[tuple[Party, State, Event], State] = {
    (P.VEHICLE, S.UNKNOWN, E.SPAWN): S.OWNED,             # BEGIN first names the vehicle
    (P.VEHICLE, S.OWNED, E.SWITCH): S.SWITCHING,          # BEGIN with IN and OUT; irrevocable
    (P.VEHICLE, S.SWITCHING, E.COMMIT): S.OWNED,          # the target has confirmed; epoch + 1
    (P.VEHICLE, S.OWNED, E.REMOVE): S.REMOVED,            # final
    (P.VEHICLE, S.SWITCHING, E.REMOVE): S.REMOVED,        # the new owner saw it leave the world

    (P.ZONE, S.UNHOSTED, E.HOST): S.HOSTED,               # incarnation 1
    (P.ZONE, S.HOSTED, E.FENCE): S.FENCED,                # messages of that process are dropped
    (P.ZONE, S.FENCED, E.HOST): S.HOSTED,                 # incarnation + 1, loaded from the store
    (P.ZONE, S.HOSTED, E.HOST): S.HOSTED,                 # a planned move, between two ticks

    (P.ROW, S.NONE, E.LOAD): S.AUTHORITATIVE,             # a new host, before its first lease
    (P.ROW, S.NONE, E.SPAWN): S.AUTHORITATIVE,
    (P.ROW, S.NONE, E.IN): S.AUTHORITATIVE,               # from the replica or the attached state
    (P.ROW, S.AUTHORITATIVE, E.OUT): S.RETAINED,          # frozen, in case the switch is repeated
    (P.ROW, S.AUTHORITATIVE, E.REMOVE): S.NONE,
    (P.ROW, S.RETAINED, E.RELEASE): S.NONE,               # the switch is committed

    (P.REPLICA, S.EMPTY, E.PREPARE): S.PREPARED,
    (P.REPLICA, S.PREPARED, E.PREPARE): S.PREPARED,       # a newer state
    (P.REPLICA, S.PREPARED, E.ABORT): S.EMPTY,            # the fence stays
    (P.REPLICA, S.EMPTY, E.ABORT): S.EMPTY,               # arrived before the PREPARE: a fence only
    (P.REPLICA, S.PREPARED, E.EXPIRE): S.EMPTY,           # K ticks without a refresh
    (P.REPLICA, S.PREPARED, E.IN): S.EMPTY,               # promoted to the row
    (P.REPLICA, S.EMPTY, E.IN): S.EMPTY,                  # the state was attached
}
# fmt: on


def after(party: Party, state: State, event: Event) -> State:
    """Return the next state. Raises ProtocolError if there is no such transition."""
    following = TABLE.get((party, state, event))
    if following is None:
        raise ProtocolError(f"{event} of {party.value}, which is {state}")
    return following


def mermaid(party: Party) -> str:
    """Return the state diagram of one party, in Mermaid's language."""
    lines = [
        f"    {state} --> {following}: {event}"
        for (whose, state, event), following in TABLE.items()
        if whose is party
    ]
    return "\n".join(["stateDiagram-v2", *lines])
