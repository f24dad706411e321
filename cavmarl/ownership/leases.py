"""The STEP of a zone: what a plan says to one of the hosts."""

from __future__ import annotations

from cavmarl.ownership.decisions import CommittedStates
from cavmarl.ownership.ledger import state_digest
from cavmarl.ownership.messages import In, Step, Switch
from cavmarl.ownership.table import Table


def make_step(table: Table, zone: int, store: CommittedStates, payload: bytes) -> Step:
    """The lease of a zone's present host for the tick in progress.

    States ride along for vehicles whose switch is forced, and for those that have to be sent again.
    """
    plan = table.planned
    enter = tuple(
        _entry(switch, store.state(switch.vehicle), switch.vehicle in plan.attach)
        for switch in plan.enter.get(zone, ())
    )
    return Step(
        table.run, table.episode, plan.record.tick, zone, table.hosts[zone][1], table.tick,
        enter, tuple(plan.leave.get(zone, ())), tuple(plan.spawn.get(zone, ())),
        plan.expected[zone], payload,
    )  # fmt: skip


def _entry(switch: Switch, state: bytes, attached: bool) -> In:
    carried = state if attached else b""
    return In(switch.vehicle, switch.epoch, attached, state_digest(state), carried)
