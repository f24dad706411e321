"""Quiet ticks, which have no messages: their results equal those of ticks with messages."""

from __future__ import annotations

import pytest

from cavmarl.core.errors import ProtocolError
from cavmarl.ownership.directory import Directory
from cavmarl.ownership.endpoint import Endpoint
from cavmarl.ownership.ledger import state_digest
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.messages import Birth, Message, Removed
from cavmarl.ownership.offers import Approach

RUN = bytes(range(16))
LIMITS = Limits()
STATE = b"state"


class Digests:
    def state(self, vehicle: int) -> bytes:
        return STATE

    def digest_of(self, vehicle: int) -> bytes:
        return state_digest(STATE)


class Both:
    """A coordinator and two zones, of which zone 0 owns vehicles 1 and 2."""

    def __init__(self) -> None:
        self.directory = Directory(RUN, (0, 1), Digests(), LIMITS)
        self.directory.reset()
        for zone in (0, 1):
            self.directory.host(zone, worker=zone)
        self.zones = {zone: Endpoint(self.directory.hosting(zone), LIMITS) for zone in (0, 1)}
        self.tell(births=[Birth(1, 0, b""), Birth(2, 0, b"")])

    def deliver(self, messages: tuple[Message, ...]) -> None:
        for message in messages:
            for to in message.destinations():
                if to in self.zones:
                    self.deliver(self.zones[to].on_message(message).messages)
                else:
                    self.directory.on_message(message)

    def tell(self, births: list[Birth], movers: list[tuple[int, int]] | None = None) -> None:
        """Run a tick with STEP and DONE."""
        self.deliver(self.directory.begin(movers or (), births).messages)
        self.deliver(tuple(zone.complete(0) for zone in self.zones.values()))
        self.directory.commit({0: 0, 1: 0})

    def leave_alone(self) -> None:
        """Run a quiet tick."""
        assert self.directory.begin_quiet()
        for zone in self.zones.values():
            zone.go_on()
            zone.rest()

    def known(self) -> tuple[object, ...]:
        table = self.directory.table
        return table.tick, table.owners, table.counts, table.tallies, self.directory.dones

    def check(self) -> None:
        for number, zone in self.zones.items():
            assert zone.tick == self.directory.table.tick
            assert zone.tally == self.directory.table.tallies[number]


def test_quiet_ticks_need_no_messages_and_give_the_same_table() -> None:
    told, quiet = Both(), Both()
    for _ in range(3):
        told.tell([])
        quiet.leave_alone()
        quiet.directory.commit_quiet()
        quiet.check()
        assert quiet.known() == told.known()
    for both in (told, quiet):
        both.tell([Birth(3, 1, b"")])
        both.check()
    assert quiet.known() == told.known()


def test_a_zone_can_end_a_quiet_tick_with_an_event() -> None:
    told, quiet = Both(), Both()
    told.deliver(told.directory.begin(()).messages)
    told.deliver((told.zones[0].complete(0, [Removed(2, 1)]), told.zones[1].complete(0)))
    told.directory.commit({0: 0, 1: 0})
    assert quiet.directory.begin_quiet()
    for zone in quiet.zones.values():
        zone.go_on()
    quiet.zones[1].rest()
    done = quiet.zones[0].complete(0, [Removed(2, 1)])
    quiet.directory.break_quiet()
    quiet.deliver((done,))
    quiet.directory.answer_for_silent()
    quiet.directory.commit({0: 0, 1: 0})
    quiet.check()
    assert quiet.known() == told.known()


def test_acknowledgements_in_a_quiet_tick_take_effect() -> None:
    both = Both()
    both.leave_alone()
    both.deliver(both.zones[0].offer([Approach(1, 1, STATE)]))
    both.directory.commit_quiet()
    both.tell([], movers=[(1, 1)])
    assert both.directory.table.owners[1] == (1, 1)
    both.check()
    both.leave_alone()
    both.directory.commit_quiet()
    both.check()
    assert not both.zones[0].retained


def test_an_episode_that_begins_in_a_quiet_tick_continues() -> None:
    both = Both()
    both.leave_alone()
    both.directory.reset()
    assert not both.directory.is_quiet
    both.tell([Birth(1, 1, b"")])
    both.check()


def test_only_one_tick_is_in_progress() -> None:
    both = Both()
    both.leave_alone()
    with pytest.raises(ProtocolError, match="tick 2 is not committed"):
        both.directory.begin(())
    both.directory.commit_quiet()
    both.directory.begin(())
    assert not both.directory.begin_quiet()
    both.zones[0].go_on()
    with pytest.raises(ProtocolError, match="zone 0 has a lease for tick 3 already"):
        both.zones[0].go_on()
    with pytest.raises(ProtocolError, match="zone 1 has no lease after tick 2"):
        both.zones[1].rest()
