"""The zone host's side of the protocol.

A host may advance its vehicles only while it has a lease. A STEP is a lease for one tick:
`on_message` returns an `Advance` for the shard, `complete` ends the lease with a DONE, and `offer`
then offers approaching vehicles to neighbours. An endpoint stores nothing permanently: after a host
dies, a new host is loaded from the committed store.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

from cavmarl.core.errors import ProtocolError
from cavmarl.ownership.ledger import OwnedTally, tally
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import (
    Abort,
    Ack,
    Confirmed,
    Done,
    Held,
    Message,
    Nack,
    Need,
    Offer,
    Prepare,
    Refusal,
    Refused,
    Removed,
    Step,
)
from cavmarl.ownership.offers import Approach, Offers
from cavmarl.ownership.reactions import Advance, Hosting, Reaction
from cavmarl.ownership.replicas import Replicas
from cavmarl.ownership.transitions import Event, Party, State, after

NOTHING = Reaction()


class Endpoint:
    """The host of one zone.

    Attributes:
        retained: vehicle → epoch of rows that are kept until their switch is committed.
        dropped: (kind, reason) → number of dropped messages or entries.
    """

    def __init__(self, hosting: Hosting, limits: Limits) -> None:
        self.run, self.episode = hosting.run, hosting.episode
        self.zone, self.incarnation = hosting.zone, hosting.incarnation
        self.tick = hosting.tick  # the tick of the rows
        self.lease: int | None = None  # the tick to which the rows may be advanced now, or None
        self.owned = dict(hosting.owned)  # vehicle → epoch
        self.tally = tally(self.run, self.owned)
        self.retained: dict[int, int] = {}
        self.replicas = Replicas(limits)  # states of vehicles that may enter
        self.offers = Offers(limits)  # states offered to neighbours
        self.dropped: Counter[tuple[str, str]] = Counter()
        self._answer: Done | None = None
        self._entering: tuple[Confirmed, ...] = ()
        self._limits = limits

    def row_state(self, vehicle: int) -> State:
        if vehicle in self.owned:
            return State.AUTHORITATIVE
        return State.RETAINED if vehicle in self.retained else State.NONE

    def on_message(self, message: Message) -> Reaction:
        """Process a message. Late messages and messages of other runs are dropped and counted."""
        reason = self._reason_to_drop(message)
        if reason is not None:
            return self._drop(message, reason)
        match message:
            case Step():
                return self._on_step(message)
            case Prepare():
                return self._on_prepare(message)
            case Abort():
                return self._on_abort(message)
            case Ack():
                self.offers.answered(message)
                return NOTHING
            case Nack():
                self.offers.refused(message)
                return NOTHING
        return self._drop(message, "kind")

    def go_on(self) -> None:
        """Take a lease for the next tick without a STEP. The zone keeps its vehicles."""
        if self.lease is not None:
            raise ProtocolError(f"zone {self.zone} has a lease for tick {self.lease} already")
        self._release()
        self._hold(self.tick + 1, ())

    def rest(self) -> None:
        """End a lease of `go_on` without a DONE; not allowed if a vehicle has left the world."""
        if self.lease is None:
            raise ProtocolError(f"zone {self.zone} has no lease after tick {self.tick}")
        self._end_lease(self.lease)

    def complete(
        self,
        rows: int,  # digest of the stored rows (`world_digest` of their `row_hash`)
        removed: Sequence[Removed] = (),  # vehicles that left the world in this tick
        payload: bytes = b"",  # data that only the runtime reads
    ) -> Done:
        """End the lease, after the result is in the store. Return the DONE."""
        if self.lease is None:
            raise ProtocolError(f"zone {self.zone} has no lease: no STEP after tick {self.tick}")
        for vehicle, _ in removed:
            after(Party.ROW, self.row_state(vehicle), Event.REMOVE)
            self.tally = self.tally.minus(self.run, vehicle, self.owned.pop(vehicle))
        self._end_lease(self.lease)
        self._answer = Done(
            self.run, self.episode, self.tick, self.zone, self.incarnation,
            confirmed=self._entering, removed=tuple(sorted(removed)),
            owned=self.tally, rows=rows, payload=payload,
        )  # fmt: skip
        return self._answer

    def _end_lease(self, tick: int) -> None:
        self.tick, self.lease = tick, None
        self.offers.unanswered.clear()  # the previous tick's offers

    def offer(self, approaches: Iterable[Approach]) -> tuple[Message, ...]:
        """Offer all approaching vehicles of a tick to other zones, after `complete`."""
        offers, withdrawn = self.offers.renew(self.tick, approaches, self.owned)
        aborts = tuple(
            Abort(self.run, self.episode, self.tick, self.zone, self.incarnation, target, entries)
            for target, entries in withdrawn.items()
        )
        return aborts + tuple(self._prepare(target, offers[target]) for target in offers)

    def offer_again(self) -> tuple[Message, ...]:
        """Return unanswered offers to be sent again; none after the last attempt of the tick."""
        offers = self.offers.again()
        return tuple(self._prepare(target, offers[target]) for target in offers)

    def refuse(self, message: Prepare, reason: Refusal = Refusal.LOAD) -> Reaction:
        """Answer a PREPARE with a NACK, by default because the host has no room."""
        if self._reason_to_drop(message) is not None:
            return self.on_message(message)
        refused = tuple(
            Refused(offer.vehicle, offer.epoch, self.replicas.refuse(offer, message.tick, reason))
            for offer in message.entries
        )
        return Reaction((Nack(*self._answer_header(message), refused),))

    def _answer_header(self, message: Prepare) -> tuple[bytes, int, int, int, int, int]:
        return (
            self.run, self.episode, message.tick, self.zone, self.incarnation, message.source,
        )  # fmt: skip

    def _prepare(self, target: int, offers: tuple[Offer, ...]) -> Prepare:
        return Prepare(
            self.run, self.episode, self.tick, self.zone, self.incarnation, target,
            self._limits.schema, offers,
        )  # fmt: skip

    def _reason_to_drop(self, message: Message) -> str | None:
        if message.run != self.run:
            return "run"
        newer = isinstance(message, Step) and message.episode > self.episode
        if message.episode != self.episode and not newer:
            return "episode"
        match message:
            case Step(zone=zone, incarnation=incarnation):
                if zone != self.zone:
                    return "zone"
                return None if incarnation == self.incarnation else "incarnation"
            case Prepare(target=zone) | Abort(target=zone) | Ack(source=zone) | Nack(source=zone):
                if zone != self.zone:
                    return "zone"
        if isinstance(message, (Ack, Nack)):
            return None if message.tick == self.tick else "tick"
        near = self.tick - self._limits.lifetime < message.tick <= self.tick + 1
        return None if near else "tick"

    def _on_step(self, step: Step) -> Reaction:
        if step.episode > self.episode:
            self._begin_episode(step)
        if step.tick == self.tick and self._answer is not None:
            return Reaction((self._answer,))
        if step.tick != self.tick + 1 or self.lease is not None:
            return self._drop(step, "tick")
        needed = tuple(
            vehicle
            for vehicle, epoch, forced, digest, _ in step.enter
            if not forced and not self.replicas.exact(vehicle, epoch - 1, self.tick, digest)
        )
        if needed:
            return Reaction(
                (Need(self.run, self.episode, step.tick, self.zone, self.incarnation, needed),)
            )
        return Reaction(advance=self._take_lease(step))

    def _take_lease(self, step: Step) -> Advance:
        release = self._release()
        leave = tuple(vehicle for vehicle, _ in step.leave)
        for vehicle in leave:
            self._leave(vehicle)
        enter = []
        for vehicle, epoch, forced, _, state in step.enter:
            self._own(vehicle, epoch, Event.IN)
            replica = self.replicas.take(vehicle)
            enter.append((vehicle, state if forced else replica))
        for vehicle, _ in step.spawn:
            self._own(vehicle, 0, Event.SPAWN)
        if step.owned != self.tally:
            step.owned.check(self.tally, f"zone {self.zone} on its way to tick {step.tick}")
        self._hold(step.tick, tuple(Confirmed(vehicle, epoch) for vehicle, epoch, *_ in step.enter))
        return Advance(
            self.episode, step.tick, release, leave, tuple(enter), step.spawn, step.payload,
        )  # fmt: skip

    def _release(self) -> tuple[int, ...]:
        """Release the rows that were kept until their switch was committed."""
        release = tuple(self.retained)
        for vehicle in release:
            after(Party.ROW, self.row_state(vehicle), Event.RELEASE)
            del self.retained[vehicle]
        return release

    def _hold(self, tick: int, entering: tuple[Confirmed, ...]) -> None:
        self.lease, self._answer, self._entering = tick, None, entering
        self.replicas.expire(self.tick)

    def _own(self, vehicle: int, epoch: int, event: Event) -> None:
        after(Party.ROW, self.row_state(vehicle), event)
        self.owned[vehicle] = epoch
        self.tally = self.tally.plus(self.run, vehicle, epoch)

    def _leave(self, vehicle: int) -> None:
        after(Party.ROW, self.row_state(vehicle), Event.OUT)
        epoch = self.owned.pop(vehicle)
        self.tally = self.tally.minus(self.run, vehicle, epoch)
        self.offers.forget(vehicle)
        self.retained[vehicle] = epoch

    def _begin_episode(self, step: Step) -> None:
        self.episode, self.tick, self.lease, self._answer = step.episode, step.committed, None, None
        self.owned, self.retained, self.tally = {}, {}, OwnedTally()
        self.replicas = Replicas(self._limits)
        self.offers = Offers(self._limits)

    def _on_prepare(self, message: Prepare) -> Reaction:
        held, refused = [], []
        for offer in message.entries:
            own = self.owned.get(offer.vehicle, -1)
            if own >= offer.epoch:
                self.dropped["Prepare", "owned"] += 1
                continue
            taken = self.replicas.prepare(offer, message.tick, message.schema)
            if isinstance(taken, Refusal):
                refused.append(Refused(offer.vehicle, offer.epoch, taken))
            elif taken:
                held.append(Held(offer.vehicle, offer.epoch, offer.digest))
            else:
                self.dropped["Prepare", "fence"] += 1
        header = self._answer_header(message)
        answers: list[Message] = []
        if held:
            answers.append(Ack(*header, tuple(held)))
        if refused:
            answers.append(Nack(*header, tuple(refused)))
        return Reaction(tuple(answers))

    def _on_abort(self, message: Abort) -> Reaction:
        for vehicle, epoch in message.entries:
            if not self.replicas.abort(vehicle, epoch, message.tick):
                self.dropped["Abort", "fence"] += 1
        return NOTHING

    def _drop(self, message: Message, reason: str) -> Reaction:
        self.dropped[type(message).__name__, reason] += 1
        return NOTHING
