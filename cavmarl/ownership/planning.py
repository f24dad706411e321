"""The plan of a tick: a function of the logged BEGIN and of the committed owners.

A running coordinator and a coordinator that replays its log make their plans with this code.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from cavmarl.core.errors import ProtocolError
from cavmarl.ownership.ledger import OwnedTally
from cavmarl.ownership.messages import Begin, Confirmed, Done, Out, Removed, Spawn, Switch


@dataclass(slots=True)
class OwnershipPlan:
    """The changes of owner between the committed tick and the next tick."""

    record: Begin  # the logged decision
    # zone → tally of its vehicles after IN, OUT and SPAWN, and before removals
    expected: Mapping[int, OwnedTally]
    switches: dict[int, Switch] = field(default_factory=dict)  # vehicle → its switch
    births: dict[int, int] = field(default_factory=dict)  # vehicle → its zone
    enter: dict[int, list[Switch]] = field(default_factory=dict)  # zone → switches into it
    leave: dict[int, list[Out]] = field(default_factory=dict)  # zone → vehicles that leave it
    spawn: dict[int, list[Spawn]] = field(default_factory=dict)  # zone → new vehicles
    attach: set[int] = field(default_factory=set)  # vehicles whose state is attached to STEP

    def changes(self, zone: int) -> bool:
        """Return whether a vehicle enters or leaves the zone, or is new in it."""
        return zone in self.enter or zone in self.leave or zone in self.spawn

    def owner(self, vehicle: int, committed: Mapping[int, tuple[int, int]]) -> tuple[int, int]:
        """Return (zone, epoch) of a vehicle under this plan."""
        if vehicle in self.switches:
            switch = self.switches[vehicle]
            return switch.target, switch.epoch
        if vehicle in self.births:
            return self.births[vehicle], 0
        return committed.get(vehicle, (-1, -1))


def make_plan(run: bytes, record: Begin, committed: Mapping[int, OwnedTally]) -> OwnershipPlan:
    """Return the plan of a BEGIN record, given the tallies of zones at the committed tick."""
    if not record.switches and not record.births:
        return OwnershipPlan(record, committed)
    expected = dict(committed)
    plan = OwnershipPlan(record, expected)
    for switch in record.switches:
        vehicle, source, target, epoch, forced = switch
        expected[source] = expected[source].minus(run, vehicle, epoch - 1)
        expected[target] = expected[target].plus(run, vehicle, epoch)
        plan.switches[vehicle] = switch
        plan.enter.setdefault(target, []).append(switch)
        plan.leave.setdefault(source, []).append(Out(vehicle, epoch - 1))
        if forced:
            plan.attach.add(vehicle)
    for vehicle, zone, state in record.births:
        expected[zone] = expected[zone].plus(run, vehicle, 0)
        plan.births[vehicle] = zone
        plan.spawn.setdefault(zone, []).append(Spawn(vehicle, state))
    return plan


def check_done(
    run: bytes, plan: OwnershipPlan, done: Done, owners: Mapping[int, tuple[int, int]]
) -> None:
    """Compare the DONE of a zone with the plan. Raises ProtocolError if they differ."""
    expected = plan.expected[done.zone]
    for vehicle, _ in done.removed:
        zone, epoch = plan.owner(vehicle, owners)
        if zone != done.zone:
            raise ProtocolError(
                f"{_where(done)} removed vehicle {vehicle}, but zone {zone} owns it"
            )
        expected = expected.minus(run, vehicle, epoch)
    planned = tuple(
        Confirmed(entry.vehicle, entry.epoch) for entry in plan.enter.get(done.zone, ())
    )
    if done.confirmed != planned:
        raise ProtocolError(
            f"{_where(done)} confirmed {list(done.confirmed)} instead of {list(planned)}"
        )
    if expected != done.owned:
        expected.check(done.owned, _where(done))


def _where(done: Done) -> str:
    return f"zone {done.zone} at tick {done.tick}"


def all_removed(dones: Iterable[Done]) -> tuple[Removed, ...]:
    """Return the vehicles that left the world, in the order of their ids."""
    return tuple(sorted(entry for done in dones for entry in done.removed))
