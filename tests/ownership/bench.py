"""A coordinator and its hosts in one process; the test delivers each message itself.

The state of a vehicle is the pair (vehicle, tick), so `Bench` is also the committed store.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from cavmarl.ownership.directory import Directory
from cavmarl.ownership.endpoint import Endpoint
from cavmarl.ownership.ledger import row_hash, state_digest, world_digest
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import COORDINATOR, Birth, Message, Output, Record, Removed, Step
from cavmarl.ownership.offers import Approach
from tests.ownership.explorer import version
from tests.ownership.recorded_trace import Trace, check_trace

RUN = bytes(range(16))


class Bench:
    """The coordinator and the hosts of zones 0, 1, … of one world."""

    def __init__(self, zones: int = 2, limits: Limits | None = None) -> None:
        self.limits = limits or Limits()
        self.directory = Directory(RUN, range(zones), self, self.limits)
        self.trace, self.log = Trace(), list[Record]()
        self.endpoints: dict[int, Endpoint] = {}
        self.entered: dict[int, bytes] = {}
        self.note(self.directory.reset())
        for zone in range(zones):
            self.host(zone)

    def state(self, vehicle: int) -> bytes:
        return version(vehicle, self.directory.table.tick)

    def digest_of(self, vehicle: int) -> bytes:
        return state_digest(self.state(vehicle))

    def note(self, output: Output) -> Output:
        """Log the records of an output."""
        self.log += output.records
        self.trace.logged(output.records)
        return output

    def host(self, zone: int) -> Output:
        output = self.note(self.directory.host(zone, worker=zone))
        self.endpoints[zone] = Endpoint(self.directory.hosting(zone), self.limits)
        return output

    def crash(self, zone: int) -> Output:
        """Replace the host of a zone, as after its death; return the output for the new host."""
        self.note(self.directory.fence(zone))
        return self.host(zone)

    def begin(
        self, movers: Iterable[tuple[int, int]] = (), births: Iterable[tuple[int, int]] = ()
    ) -> tuple[Step, ...]:
        """Begin a tick with moving and new vehicles, as pairs (vehicle, zone); return the STEPs."""
        new = [Birth(vehicle, zone, self.state(vehicle)) for vehicle, zone in births]
        output = self.note(self.directory.begin(movers, new))
        return tuple(message for message in output.messages if isinstance(message, Step))

    def give(self, message: Message, removed: Sequence[int] = ()) -> tuple[Message, ...]:
        """Deliver a message; return the answers of its receiver, such as the DONE after a STEP."""
        destination, *copies = message.destinations()
        for zone in copies:
            self.trace.delivered(zone, message)
            self.endpoints[zone].on_message(message)
        self.trace.delivered(destination, message)
        if destination == COORDINATOR:
            return self.note(self.directory.on_message(message)).messages
        endpoint = self.endpoints[destination]
        reaction = endpoint.on_message(message)
        if reaction.advance is None:
            return reaction.messages
        tick = reaction.advance.tick
        self.entered |= dict(reaction.advance.enter)
        rows = world_digest(
            row_hash(vehicle, version(vehicle, tick))
            for vehicle in endpoint.owned
            if vehicle not in removed
        )
        gone = [Removed(vehicle, 0) for vehicle in removed if vehicle in endpoint.owned]
        return (endpoint.complete(rows, gone),)

    def offer(self, zone: int, *approaches: tuple[int, int]) -> tuple[Message, ...]:
        """Let the host of a zone offer pairs (vehicle, target); return its messages."""
        endpoint = self.endpoints[zone]
        return endpoint.offer(
            Approach(vehicle, target, version(vehicle, endpoint.tick))
            for vehicle, target in approaches
        )

    def pass_on(self, messages: Iterable[Message]) -> None:
        """Deliver messages and all answers to them, until no party sends another message."""
        for message in messages:
            self.pass_on(self.give(message))

    def commit(self) -> None:
        rows = {zone: done.rows for zone, done in self.directory.dones.items()}
        self.note(self.directory.commit(rows))

    def tick(
        self,
        movers: Iterable[tuple[int, int]] = (),
        births: Iterable[tuple[int, int]] = (),
        offers: Sequence[tuple[int, int]] = (),
        removed: Sequence[int] = (),
    ) -> tuple[Message, ...]:
        """Run a tick without faults, in which all offers (vehicle, target) are answered."""
        sent: list[Message] = []
        for step in self.begin(movers, births):
            for done in self.give(step, removed):
                self.give(done)
        for zone, endpoint in self.endpoints.items():
            mine = [offer for offer in offers if offer[0] in endpoint.owned and offer[1] != zone]
            sent += self.offer(zone, *mine)
        self.pass_on(sent)
        self.commit()
        return tuple(sent)

    def owner(self, vehicle: int) -> int:
        return self.directory.table.owners[vehicle][0]

    def judge(self) -> None:
        check_trace(self.trace.entries, self.limits.deferral, self.limits.lifetime)
