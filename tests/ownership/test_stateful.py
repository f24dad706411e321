"""Any sequence of events and faults keeps the owners of a simple model (acceptance test AT9)."""

from __future__ import annotations

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from cavmarl.ownership.directory import Directory
from cavmarl.ownership.limits import Limits
from cavmarl.ownership.log_records import replay
from cavmarl.ownership.messages import COORDINATOR, Abort, Ack, Message, Nack, Prepare, Step
from tests.ownership.bench import Bench
from tests.ownership.recorded_trace import lines_of, records_from_lines

ZONES = 3
FATES = st.sampled_from(["arrives", "arrives", "is lost", "is doubled", "is late"])


class Ownership(RuleBasedStateMachine):
    """A state machine whose model is a dictionary: vehicle → zone."""

    def __init__(self) -> None:
        super().__init__()
        self.where: dict[int, int] = {}
        self.next_id = 0
        self.newborn: dict[int, int] = {}
        self.gone: set[int] = set()
        self.late: list[Message] = []

    @initialize(deferral=st.integers(0, 3))
    def open(self, deferral: int) -> None:
        self.bench = Bench(ZONES, limits=Limits(deferral=deferral, lifetime=4))

    @rule(zone=st.integers(0, ZONES - 1))
    def spawn(self, zone: int) -> None:
        self.newborn[self.next_id] = zone
        self.next_id += 1

    @rule(data=st.data(), zone=st.integers(0, ZONES - 1))
    def move(self, data: st.DataObject, zone: int) -> None:
        if self.where:
            self.where[data.draw(st.sampled_from(sorted(self.where)))] = zone

    @rule(data=st.data())
    def remove(self, data: st.DataObject) -> None:
        if self.where:
            self.gone.add(data.draw(st.sampled_from(sorted(self.where))))

    @rule(zone=st.integers(0, ZONES - 1), planned=st.booleans())
    def replace_a_host(self, zone: int, planned: bool) -> None:
        if planned:
            self.bench.host(zone)
        else:
            self.bench.crash(zone)

    @rule()
    def restart_the_coordinator(self) -> None:
        bench = self.bench
        bench.directory = Directory.restore(bench.log, range(ZONES), bench, bench.limits)

    @rule()
    def reset(self) -> None:
        self.bench.note(self.bench.directory.reset())
        self.where, self.newborn, self.gone, self.next_id = {}, {}, set(), 0

    @rule()
    def late_messages_arrive(self) -> None:
        late, self.late = self.late, []
        self.carry(late)

    @rule(
        data=st.data(),
        dies=st.one_of(st.none(), st.integers(COORDINATOR, ZONES - 1)),
        near=st.booleans(),
    )
    def tick(self, data: st.DataObject, dies: int | None, near: bool) -> None:
        bench = self.bench
        movers = [(v, z) for v, z in self.where.items() if bench.owner(v) != z]
        steps: list[Message] = list(bench.begin(movers, self.newborn.items()))
        self.where |= self.newborn
        self.newborn = {}
        if dies == COORDINATOR:
            self.restart_the_coordinator()
        elif dies is not None:
            steps += bench.crash(dies).messages
        while bench.directory.waiting_for():
            self.carry(steps, data)
            steps = list(bench.directory.resend().messages)
        for zone, endpoint in bench.endpoints.items():
            mine = [v for v in sorted(endpoint.owned) if near or self.where[v] != zone]
            targets = [(v, to) for v in mine for to in range(ZONES) if to != zone]
            self.carry(bench.offer(zone, *targets), data)
        bench.commit()
        for vehicle in self.gone:
            del self.where[vehicle]
        self.gone = set()

    def carry(self, messages: list[Message] | tuple[Message, ...], data: object = None) -> None:
        for message in messages:
            fate = data.draw(FATES) if isinstance(data, st.DataObject) else "arrives"
            if fate == "is late":
                self.late.append(message)
            for _ in range({"arrives": 1, "is doubled": 2}.get(fate, 0)):
                self.carry(self.bench.give(message, sorted(self.gone)), data)

    @invariant()
    def owners_are_those_of_the_model(self) -> None:
        if not hasattr(self, "bench"):
            return
        table = self.bench.directory.table
        assert table.owners.keys() == self.where.keys()
        longest = self.bench.limits.deferral
        assert all(ticks <= longest for ticks in table.deferred.values())
        waiting = set(table.deferred)
        for zone, endpoint in self.bench.endpoints.items():
            if endpoint.episode == table.episode and endpoint.tick == table.tick:
                mine = {v: epoch for v, (owner, epoch) in table.owners.items() if owner == zone}
                assert endpoint.owned == mine
        assert waiting <= self.where.keys()

    def teardown(self) -> None:
        if not hasattr(self, "bench"):
            return
        bench = self.bench
        bench.judge()
        text = "".join(lines_of(bench.log))
        assert replay(records_from_lines(text)).owners == bench.directory.table.owners


Ownership.TestCase.settings = settings(max_examples=120, stateful_step_count=30, deadline=None)
test_any_sequence_keeps_the_owners_of_the_model = Ownership.TestCase


def test_messages_include_all_kinds_that_may_be_lost() -> None:
    assert {Step, Prepare, Abort, Ack, Nack} <= set(Message.__subclasses__())
