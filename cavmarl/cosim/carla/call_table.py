"""`CALLS`: the calls of CARLA's client that a server knows, and how it answers them."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any, TypeVar

from cavmarl.core.errors import CavmarlError
from cavmarl.cosim.carla.call_arguments import CallRefused, Check
from cavmarl.cosim.carla.rpc_messages import (
    failed_nothing,
    failed_value,
    nothing_answer,
    value_answer,
)

if TYPE_CHECKING:
    from cavmarl.cosim.carla.carla_session import CarlaSession

log = logging.getLogger("cavmarl.carla")

Handler = TypeVar("Handler", bound=Callable[..., Any])


class Effect(Enum):
    """The kind of effect of a call."""

    WORKS = "works"
    ACCEPTED = "accepted without effect"
    REFUSED = "refused"


class Returns(Enum):
    """The form of a call's answer."""

    VALUE = "value"
    NOTHING = "nothing"
    BARE = "bare value"  # without the outer array


@dataclass(frozen=True)
class ClientCall:
    """One call.

    Attributes:
        checks: checks of the arguments.
        required: number of necessary arguments; other versions add or omit arguments.
        act: called with the caller, the session and the checked arguments; None: the call
            returns `constant`.
        note: remark for the reference page; for a refused call, the reason.
    """

    name: str
    checks: tuple[Check, ...]
    required: int
    returns: Returns
    effect: Effect
    act: Callable[..., Any] | None = None
    constant: Any = None
    note: str = ""

    def carry_out(self, caller: Caller, session: CarlaSession, arguments: list[Any]) -> Any:
        """Check the arguments and return the value of the call.

        Raises CallRefused: the number or the type of arguments is wrong, or the call is refused.
        """
        given = len(arguments)
        if not self.required <= given <= len(self.checks):
            wanted = f"{self.required}"
            if self.required != len(self.checks):
                wanted += f" to {len(self.checks)}"
            raise CallRefused(f"{self.name}: {given} arguments; {wanted} are expected")
        try:
            checked = [check(one) for check, one in zip(self.checks, arguments, strict=False)]
        except CallRefused as problem:
            raise CallRefused(f"{self.name}: {problem}") from None
        if self.effect is Effect.REFUSED:
            raise CallRefused(self.note)
        return self.constant if self.act is None else self.act(caller, session, *checked)


class Caller:
    """One connected client. `agents`: indices of the agents that it drives."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.agents: set[int] = set()


CALLS: dict[str, ClientCall] = {}


def call(
    name: str,
    *checks: Check,
    returns: Returns = Returns.VALUE,
    effect: Effect = Effect.WORKS,
    required: int | None = None,
    note: str = "",
) -> Callable[[Handler], Handler]:
    """Return a decorator that adds a handler to the table."""

    def add(handler: Handler) -> Handler:
        fewest = len(checks) if required is None else required
        CALLS[name] = ClientCall(name, checks, fewest, returns, effect, handler, note=note)
        return handler

    return add


def accept(*names: str, checks: tuple[Check, ...], note: str = "") -> None:
    """Add calls that return nothing and have no effect."""
    for name in names:
        CALLS[name] = ClientCall(
            name, checks, len(checks), Returns.NOTHING, Effect.ACCEPTED, note=note
        )


def answer_constant(
    value: Any, *names: str, checks: tuple[Check, ...] = (), note: str = ""
) -> None:
    """Add calls that always return the same value."""
    for name in names:
        CALLS[name] = ClientCall(
            name, checks, len(checks), Returns.VALUE, Effect.ACCEPTED, constant=value, note=note
        )


def answer_from(name: str, read: Callable[[CarlaSession], Any], note: str = "") -> None:
    """Add a call without arguments that returns a value of the session."""
    call(name, note=note)(lambda caller, session: read(session))


def refuse(
    *names: str,
    checks: tuple[Check, ...],
    because: str,
    returns: Returns = Returns.NOTHING,
    required: int | None = None,
) -> None:
    """Add calls that are refused with a reason."""
    fewest = len(checks) if required is None else required
    for name in names:
        CALLS[name] = ClientCall(name, checks, fewest, returns, Effect.REFUSED, note=because)


def answer(
    caller: Caller, session: CarlaSession, name: str, arguments: list[Any]
) -> tuple[str | None, Any]:
    """Return error and result of a call. Faults are logged and never raised."""
    known = CALLS.get(name)
    if known is None:
        session.tell(f"{caller.name}: no call {name[:80]!r}")
        count = len(arguments) + 1
        return (
            f"rpclib: server could not find function '{name[:80]}' with argument count {count}.",
            None,
        )
    try:
        value = known.carry_out(caller, session, arguments)
    except (CallRefused, CavmarlError) as problem:
        message = str(problem)
        session.tell(f"{caller.name}: {name}: {message.removeprefix(f'{name}: ')}")
    except Exception as problem:  # a fault of the server must not end the world of other clients
        log.exception("%s: %s", caller.name, name)
        message = f"internal error in {name}: {problem!r}"
    else:
        if known.returns is Returns.BARE:
            return None, value
        return None, nothing_answer() if known.returns is Returns.NOTHING else value_answer(value)
    failed = failed_nothing if known.returns is Returns.NOTHING else failed_value
    return None, failed(message)
