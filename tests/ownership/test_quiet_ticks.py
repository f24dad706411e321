"""Ticks without messages (quiet ticks) give the results of ticks with messages."""

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


class World:
    """A coordinator and two zones, of which zone 0 owns vehicles 1 and 2."""

    def __init__(self) -> None:
        self.directory = Directory(RUN, (0, 1), Digests(), LIMITS)
        self.directory.reset()
        for zone in (0, 1):
            self.directory.host(zone, worker=zone)
        self.zones = {zone: Endpoint(self.directory.hosting(zone), LIMITS) for zone in (0, 1)}
        self.tick_with_messages(births=[Birth(1, 0, b""), Birth(2, 0, b"")])

    def deliver(self, messages: tuple[Message, ...]) -> None:
        for message in messages:
            for to in message.destinations():
                if to in self.zones:
                    self.deliver(self.zones[to].on_message(message).messages)
                else:
                    self.directory.on_message(message)

    def tick_with_messages(
        self, births: list[Birth], movers: list[tuple[int, int]] | None = None
    ) -> None:
        """Run a tick with STEP and DONE messages."""
        self.deliver(self.directory.begin(movers or (), births).messages)
        self.deliver(tuple(zone.complete(0) for zone in self.zones.values()))
        self.directory.commit({0: 0, 1: 0})

    def quiet_tick(self) -> None:
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


def test_quiet_ticks_give_the_same_table_as_ticks_with_messages() -> None:
    told, quiet = World(), World()
    for _ in range(3):
        told.tick_with_messages([])
        quiet.quiet_tick()
        quiet.directory.commit_quiet()
        quiet.check()
        assert quiet.known() == told.known()
    for both in (told, quiet):
        both.tick_with_messages([Birth(3, 1, b"")])
        both.check()
    assert quiet.known() == told.known()


def test_a_zone_can_end_a_quiet_tick_with_an_event() -> None:
    told, quiet = World(), World()
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
    both = World()
    both.quiet_tick()
    both.deliver(both.zones[0].offer([Approach(1, 1, STATE)]))
    both.directory.commit_quiet()
    both.tick_with_messages([], movers=[(1, 1)])
    assert both.directory.table.owners[1] == (1, 1)
    both.check()
    both.quiet_tick()
    both.directory.commit_quiet()
    both.check()
    assert not both.zones[0].retained


def test_a_reset_during_a_quiet_tick_begins_a_normal_episode() -> None:
    both = World()
    both.quiet_tick()
    both.directory.reset()
    assert not both.directory.is_quiet
    both.tick_with_messages([Birth(1, 1, b"")])
    both.check()


def test_only_one_tick_is_in_progress() -> None:
    both = World()
    both.quiet_tick()
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
