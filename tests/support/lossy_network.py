"""A network in memory whose faults are determined by a seed.

Whether a message has a fault depends on the seed and on the key of the message, never on timing. A
message that is sent in phase k arrives in phase k + 1, unless the plan drops or delays it. Runs
with faults can therefore be repeated bit for bit.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any, NamedTuple

from cavmarl.core.errors import ConfigError, MessageError
from cavmarl.ownership.codec import decode, encode
from cavmarl.ownership.messages import COORDINATOR, Message, Step


@dataclass(frozen=True, slots=True)
class Rates:
    """Probabilities of faults of one kind of message.

    Attributes:
        drop: the message never arrives.
        delay: the message arrives 1 to `longest_delay` phases late.
        duplicate: the message arrives again in a later phase.
        reorder: the message arrives after other messages of its phase.
        corrupt: a bit of the message flips, and the receiver refuses the message.
        refuse: the target of a PREPARE answers with a NACK.
        longest_delay: longest delay in phases.

    Raises:
        ConfigError: a rate is not a probability, or the delay is not a positive whole number.
    """

    drop: float = 0.0
    delay: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    corrupt: float = 0.0
    refuse: float = 0.0
    longest_delay: int = 8

    def __post_init__(self) -> None:
        for name in ("drop", "delay", "duplicate", "reorder", "corrupt", "refuse"):
            check_rate(f"the rate of {name}", getattr(self, name), 1.0)
        check_whole("longest_delay", self.longest_delay, 1)


def check_rate(name: str, value: Any, most: float) -> None:
    """Check that a value is a probability up to `most`."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not 0.0 <= value <= most:
        raise ConfigError(f"{name} is {value!r}: must be a number from 0 to {most:g}")


def check_whole(name: str, value: Any, least: int) -> None:
    """Check that a value is a whole number of at least `least`."""
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise ConfigError(f"{name} is {value!r}: must be a whole number, {least} or more")


FAULTLESS = Rates()


@dataclass(frozen=True, slots=True)
class FaultPlan:
    """The faults of messages."""

    seed: int = 0  # seed of all random choices
    # kind of message (`"Prepare"`, `"Ack"`, …) → rates; `otherwise` holds for other kinds
    rates: Mapping[str, Rates] = field(default_factory=dict)
    otherwise: Rates = FAULTLESS
    until: int | None = None  # the first phase without faults; None means that faults never end
    # the first tick whose messages have no faults; None means that faults never end
    until_tick: int | None = None

    def of(self, kind: str, phase: int, tick: int = 0) -> Rates:
        """Return the fault rates of a kind of message that is sent in a phase of a tick."""
        if self.until is not None and phase >= self.until:
            return FAULTLESS
        if self.until_tick is not None and tick >= self.until_tick:
            return FAULTLESS
        return self.rates.get(kind, self.otherwise)

    def chance(self, key: tuple[object, ...], question: str) -> float:
        """Return a number in [0, 1) from the seed, the message's key and the decision to make."""
        text = repr((self.seed, key, question)).encode()
        return int.from_bytes(blake2b(text, digest_size=7).digest(), "little") / (1 << 56)


class Delivery(NamedTuple):
    """A message at its destination; with `refused`, the target answers a PREPARE with a NACK."""

    destination: int
    message: Message
    refused: bool = False


class _Flight(NamedTuple):
    phase: int
    rank: float
    sequence: int
    delivery: Delivery


class Network:
    """Carries messages from phase to phase."""

    def __init__(self, plan: FaultPlan | None = None) -> None:
        self.plan = FaultPlan() if plan is None else plan
        self.phase = 0  # number of calls of `deliver`
        self.sent: Counter[str] = Counter()  # kind → number of sent copies
        self.faults: Counter[tuple[str, str]] = Counter()  # (kind, fault) → number of faults
        self._flights: list[_Flight] = []
        self._copies: Counter[tuple[object, ...]] = Counter()
        self._sequence = 0

    def send(self, messages: Iterable[Message]) -> None:
        """Send each message to all its destinations."""
        for message in messages:
            for destination in message.destinations():
                self._send(message, destination)

    def deliver(self) -> list[Delivery]:
        """Begin the next phase; return its deliveries in order."""
        self.phase += 1
        self._copies.clear()
        due = sorted(flight[:3] for flight in self._flights if flight.phase <= self.phase)
        deliveries = {flight.sequence: flight.delivery for flight in self._flights}
        self._flights = [flight for flight in self._flights if flight.phase > self.phase]
        return [deliveries[sequence] for _, _, sequence in due]

    def in_flight(self) -> int:
        return len(self._flights)

    def _send(self, message: Message, destination: int) -> None:
        kind = type(message).__name__
        sender = COORDINATOR if isinstance(message, Step) else _sender(message)
        place = (kind, message.episode, message.tick, sender, destination, self.phase)
        self._copies[place] += 1
        key = (*place, self._copies[place])
        rates = self.plan.of(kind, self.phase, message.tick)
        self.sent[kind] += 1
        if self._has_fault(kind, key, "drop", rates.drop):
            return
        if self._has_fault(kind, key, "corrupt", rates.corrupt) and self._damaged(message, key):
            return
        at, rank = self.phase + 1, 0.0
        if self._has_fault(kind, key, "delay", rates.delay):
            at += self._later(key, "how long", rates)
        if self._has_fault(kind, key, "reorder", rates.reorder):
            rank = self.plan.chance(key, "place")
        refused = kind == "Prepare" and self._has_fault(kind, key, "refuse", rates.refuse)
        delivery = Delivery(destination, message, refused)
        self._fly(at, rank, delivery)
        if self._has_fault(kind, key, "duplicate", rates.duplicate):
            self._fly(at + self._later(key, "the copy", rates), rank, delivery)

    def _has_fault(self, kind: str, key: tuple[object, ...], fault: str, rate: float) -> bool:
        if rate <= 0.0 or self.plan.chance(key, fault) >= rate:
            return False
        self.faults[kind, fault] += 1
        return True

    def _later(self, key: tuple[object, ...], question: str, rates: Rates) -> int:
        return 1 + int(self.plan.chance(key, question) * rates.longest_delay)

    def _fly(self, phase: int, rank: float, delivery: Delivery) -> None:
        self._flights.append(_Flight(phase, rank, self._sequence, delivery))
        self._sequence += 1

    def _damaged(self, message: Message, key: tuple[object, ...]) -> bool:
        """Return whether the receiver detects a flipped bit in the message's bytes."""
        wire = bytearray(encode(message))
        bit = int(self.plan.chance(key, "bit") * len(wire) * 8)
        wire[bit // 8] ^= 1 << (bit % 8)
        try:
            decode(bytes(wire))
        except MessageError:
            return True
        return False


def _sender(message: Message) -> int:
    sender: int = getattr(message, "zone", getattr(message, "source", COORDINATOR))
    return sender
