"""`SimulatedFaults`: faults in the processes, the clocks and the network of a simulated machine."""

from __future__ import annotations

import math
import random
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import StrEnum
from functools import partial

from cavmarl.parallel.nodes.link import HEAD_BYTES, MAGIC, FrameKind
from cavmarl.verify.simulated_machine import (
    LATEST_S,
    SimulatedMachine,
    SimulatedProcess,
    SimulatedSocket,
)

SKEW_S = 1e6  # limit of the offset of a clock
CLOCK_RATES = (0.8, 1.25)  # limits of the rate of a clock, s per simulated s
JUMP_S = 0.3  # longest jump of a clock

NODE_KINDS = (FrameKind.REPORT, FrameKind.MESSAGES, FrameKind.SHARE, FrameKind.KEEP)
RECOVERY_KINDS = (FrameKind.SYNC, FrameKind.REPORT, FrameKind.GIVE, FrameKind.MISSED)
CALLER_KINDS = (FrameKind.COMMAND, FrameKind.RECOVER)
LATER_FRAMES = 4  # a process dies while it sends one of its next `LATER_FRAMES` frames of a kind


class Fault(StrEnum):
    """A kind of fault."""

    DELAY = "delay"  # a frame and its successors on the connection arrive up to 0.5 s late
    SPLIT = "split"  # a frame arrives in two pieces
    OVERTAKE = "overtake"  # a frame arrives after frames that were sent later on other connections
    SLOW = "slow"  # the zones of a node take longer
    CLOCK_SKEW = "clock_skew"  # a clock jumps forward, and continues at another rate
    STALE_HEARTBEAT = "stale_heartbeat"  # a node answers a ping late, but within the time limit
    LOST_HEARTBEAT = "lost_heartbeat"  # a living node answers a ping too late, and is replaced
    LOSE = "lose"  # a frame never arrives, but its successors do
    DUPLICATE = "duplicate"  # a frame arrives twice
    REORDER = "reorder"  # a frame arrives after the next frame of its connection
    DAMAGE = "damage"  # one bit of a frame flips
    SILENCE = "silence"  # no further bytes arrive in one direction of a connection
    PARTITION = "partition"  # no further bytes arrive between a node and all other processes
    CUT = "cut"  # a connection ends
    STOP = "stop"  # a node stops for up to 60 s, and continues
    STOP_CALLER = "stop_caller"  # the caller stops for up to 30 s, and continues
    KILL = "kill"  # a node dies at any time
    KILL_AT_POINT = "kill_at_point"  # a node dies while it sends a frame of a random kind
    KILL_IN_RECOVERY = "kill_in_recovery"  # a node dies, and another node dies during the recovery
    END_CALLER = "end_caller"  # the caller dies at any time; all nodes must end
    END_CALLER_AT_POINT = "end_caller_at_point"  # the caller dies while it sends a frame


# These faults must not cost a node: the transport and the time limits tolerate them.
TOLERATED = (
    Fault.DELAY, Fault.SPLIT, Fault.OVERTAKE, Fault.SLOW, Fault.CLOCK_SKEW, Fault.STALE_HEARTBEAT,
    Fault.STOP_CALLER,
)  # fmt: skip
CALLER_DEATHS = (Fault.END_CALLER, Fault.END_CALLER_AT_POINT)
NODE_DEATHS = (Fault.KILL, Fault.KILL_AT_POINT, Fault.KILL_IN_RECOVERY)
DEATHS = (*NODE_DEATHS, *CALLER_DEATHS)
FAULTS = tuple(fault for fault in Fault if fault not in CALLER_DEATHS)
SEVERE = tuple(fault for fault in FAULTS if fault not in TOLERATED)  # each may cost a node

# Probability of each fault, per sent frame.
TOLERATED_RATES: Mapping[Fault, float] = {
    Fault.DELAY: 0.15,
    Fault.SPLIT: 0.15,
    Fault.OVERTAKE: 0.15,
    Fault.SLOW: 0.08,
    Fault.CLOCK_SKEW: 0.03,
    Fault.STALE_HEARTBEAT: 0.01,  # the probability that the next report of a node is late
}
SEVERE_RATES: Mapping[Fault, float] = dict.fromkeys(SEVERE, 3e-4) | dict.fromkeys(
    NODE_DEATHS, 1.5e-3
)
# Range of the pause after a severe fault drawn by rate, so that worlds recover from most of them.
# Tolerated faults are short, so that even many of them stay below the time limits.
SEVERE_APART_S = (0.0, 1.0)
SHORT_DELAY_S = 0.01
SHORT_LAG_S = 0.005
SHORT_JUMP_S = 0.002
# Delays of a report that make the caller send a ping, whether its clock is fast or slow. The answer
# to the ping follows the report and still arrives in time.
STALE_S = (1.28, 1.45)


def random_clock(drawn: random.Random) -> tuple[float, float]:
    """Return the offset of a clock at time 0, and its rate."""
    return drawn.uniform(-SKEW_S, SKEW_S), drawn.uniform(*CLOCK_RATES)


class SimulatedFaults:
    """Injects faults, and counts them.

    A fault without effect, such as a fault in a connection that sends no more frames, is not
    counted.

    Attributes:
        injected: number of faults that have happened, by kind.
    """

    def __init__(
        self,
        machine: SimulatedMachine,
        drawn: random.Random,
        rates: Mapping[Fault, float],  # probability of each fault, per sent frame
    ) -> None:
        self._machine, self._drawn = machine, drawn
        self.injected: Counter[Fault] = Counter()
        self._rates = tuple(rates.items())
        self._calm_until_s = math.inf  # earliest time of the next severe fault by rate
        self._stale: set[SimulatedProcess] = set()  # nodes whose next report is late
        machine.before_send = self._before_send

    @property
    def deaths(self) -> int:
        """The number of processes that faults have ended."""
        return sum(self.injected[fault] for fault in DEATHS)

    def begin_severe(self) -> None:
        """Draw severe faults for sent frames from now on.

        Do not call this before the worlds begin: the starter of the nodes cannot handle lost nodes.
        """
        self._calm_until_s = self._machine.now_s

    def inject(self, fault: Fault) -> None:
        """Inject a fault into a random process or connection, now or soon."""
        drawn = self._drawn
        match fault:
            case Fault.STOP_CALLER:
                self.injected[fault] += 1
                self._stop(self._machine.caller, (0.1, 30.0))
            case Fault.END_CALLER:
                self._end(fault, self._machine.caller)
            case Fault.END_CALLER_AT_POINT:
                self._end_caller_at_point()
            case Fault.CLOCK_SKEW:
                self._skew(drawn.choice(self._machine.processes), JUMP_S)
            case Fault.DELAY | Fault.SPLIT | Fault.OVERTAKE | Fault.LOSE | Fault.DUPLICATE:
                self._change_next_frame(fault, self._connection_end())
            case Fault.REORDER | Fault.DAMAGE | Fault.SILENCE | Fault.CUT:
                self._change_next_frame(fault, self._connection_end())
            case _:
                if node := self._node():
                    self._inject_into_node(fault, node)

    def _inject_into_node(self, fault: Fault, node: SimulatedProcess) -> None:
        drawn, machine = self._drawn, self._machine
        match fault:
            case Fault.SLOW:
                self.injected[fault] += 1
                node.slowness_s = drawn.choice((0.001, 0.005))
            case Fault.STALE_HEARTBEAT:
                self._stale.add(node)
            case Fault.LOST_HEARTBEAT:
                self._change_next_frame(fault, self._to_caller(node))
            case Fault.PARTITION:
                self.injected[fault] += 1
                for pair in machine.connections:
                    if node in (pair[0].owner, pair[1].owner):
                        for end in pair:
                            end.fall_silent()
            case Fault.STOP:
                self.injected[fault] += 1
                self._stop(node, (0.1, 1.5, 20.0, 60.0))
            case Fault.KILL:
                self._end(fault, node)
            case Fault.KILL_AT_POINT:
                self._end_at_point(fault, node, NODE_KINDS)
            case Fault.KILL_IN_RECOVERY:
                self._end(fault, node)
                if other := self._node():
                    self._end_at_point(fault, other, RECOVERY_KINDS, later=1)
            case _:
                raise AssertionError(f"{fault} is not a fault of nodes")

    # Processes

    def _node(self) -> SimulatedProcess | None:
        caller = self._machine.caller
        nodes = [one for one in self._machine.processes if one is not caller and not one.is_ended]
        return self._drawn.choice(nodes) if nodes else None

    def _end(self, fault: Fault, process: SimulatedProcess) -> None:
        if not process.is_ended:
            self.injected[fault] += 1
            self._machine.end(process)

    def _end_at_point(
        self,
        fault: Fault,
        process: SimulatedProcess,
        kinds: Sequence[FrameKind],
        later: int = LATER_FRAMES,
    ) -> None:
        """End a process while it sends one of the next frames of a kind."""
        kind, share = self._drawn.choice(kinds), self._drawn.choice((0.0, 0.5, 1.0))
        self._end_at_frame(fault, process, kind, share, self._drawn.randrange(later))

    def _end_caller_at_point(self) -> None:
        """End the caller while it sends a command or orders the recovery from a node's death."""
        drawn, kind = self._drawn, self._drawn.choice(CALLER_KINDS)
        if kind is FrameKind.RECOVER:
            self.inject(Fault.KILL)
        share, left = drawn.choice((0.0, 0.5, 1.0)), drawn.randrange(2)
        self._end_at_frame(Fault.END_CALLER_AT_POINT, self._machine.caller, kind, share, left)

    def _end_at_frame(
        self,
        fault: Fault,
        process: SimulatedProcess,
        kind: FrameKind,
        share: float,  # share of the frame that is still sent
        left: int,  # number of frames of this kind that are sent before
    ) -> None:
        def sent(data: bytes) -> int | None:
            nonlocal left
            if kind_of(data) is not kind or process.is_ended:
                return None
            left -= 1
            if left >= 0:
                return None
            self.injected[fault] += 1
            return int(share * len(data))

        process.on_send = sent

    def _stop(self, process: SimulatedProcess, times_s: Sequence[float]) -> None:
        process.stopped_until_s = self._machine.now_s + self._drawn.choice(times_s)

    def _skew(self, process: SimulatedProcess, jump_s: float) -> None:
        self.injected[Fault.CLOCK_SKEW] += 1
        process.set_clock(self._drawn.uniform(0.0, jump_s), self._drawn.uniform(*CLOCK_RATES))

    # Connections

    def _connection_end(self) -> SimulatedSocket | None:
        open_ones = [pair for pair in self._machine.connections if not pair[0].is_closed]
        return self._drawn.choice(self._drawn.choice(open_ones)) if open_ones else None

    def _to_caller(self, node: SimulatedProcess) -> SimulatedSocket | None:
        """Return a node's end of its connection to the caller."""
        for pair in self._machine.connections:
            if {node, self._machine.caller} == {pair[0].owner, pair[1].owner}:
                return pair[0] if pair[0].owner is node else pair[1]
        return None

    def _change_next_frame(
        self,
        fault: Fault,
        end: SimulatedSocket | None,
        delay_s: float = 0.5,
    ) -> None:
        """Inject a fault into the next frame that one end of a connection sends."""
        if end is None or end.other is None:
            return
        drawn = self._drawn
        match fault:
            case Fault.CUT:
                self.injected[fault] += 1
                end.close()
                end.other.close()
            case Fault.SILENCE:
                self.injected[fault] += 1
                end.fall_silent()
            case Fault.OVERTAKE:
                end.due = self._held(None, end, drawn.uniform(LATEST_S, 3.0 * LATEST_S))
                end.on_arrival = self._count_overtaken
            case Fault.DELAY:
                end.due = self._held(fault, end, drawn.uniform(0.0, delay_s))
            case Fault.LOST_HEARTBEAT:
                end.due = self._held(fault, end, drawn.uniform(3.0, 30.0))
            case Fault.REORDER:
                end.due = partial(self._swapped, end)
            case _:
                change = {
                    Fault.SPLIT: _split,
                    Fault.LOSE: _lost,
                    Fault.DUPLICATE: _doubled,
                    Fault.DAMAGE: _damaged,
                }[fault]
                end.due = self._counted(fault, partial(change, drawn))

    def _counted(
        self, fault: Fault, change: Callable[[bytes], list[bytes]]
    ) -> Callable[[bytes], list[bytes]]:
        def counting(data: bytes) -> list[bytes]:
            self.injected[fault] += 1
            return change(data)

        return counting

    def _held(
        self, fault: Fault | None, end: SimulatedSocket, delay_s: float
    ) -> Callable[[bytes], list[bytes]]:
        def hold(data: bytes) -> list[bytes]:
            end.held_until_s = max(end.held_until_s, self._machine.now_s + delay_s)
            if fault is not None:
                self.injected[fault] += 1
            return [data]

        return hold

    def _swapped(self, end: SimulatedSocket, data: bytes) -> list[bytes]:
        end.due = self._counted(Fault.REORDER, lambda following: [following, data])
        return []

    def _count_overtaken(self, is_overtaken: bool) -> None:
        self.injected[Fault.OVERTAKE] += is_overtaken

    # Faults by rate

    def _before_send(self, end: SimulatedSocket, data: bytes) -> None:
        self._hold_report(end, data)
        if not self._rates:
            return
        value = self._drawn.random()
        for fault, rate in self._rates:
            value -= rate
            if value < 0.0:
                self._inject_at_frame(fault, end)
                return

    def _inject_at_frame(self, fault: Fault, end: SimulatedSocket) -> None:
        machine, drawn = self._machine, self._drawn
        process = end.owner
        if fault in SEVERE:
            if machine.now_s < self._calm_until_s:
                return
            self._calm_until_s = machine.now_s + drawn.uniform(*SEVERE_APART_S)
        if fault is Fault.CLOCK_SKEW:
            self._skew(process, SHORT_JUMP_S)
        elif fault is Fault.SLOW:
            if process is not machine.caller:
                self.injected[fault] += 1
                process.lag_s = drawn.uniform(0.0, SHORT_LAG_S)
        elif fault is Fault.STALE_HEARTBEAT:
            self._stale.add(process)
        elif fault in (*NODE_DEATHS, Fault.STOP, Fault.PARTITION, Fault.LOST_HEARTBEAT):
            machine.at(0.0, partial(self.inject, fault))
        else:
            self._change_next_frame(fault, end, SHORT_DELAY_S)

    def _hold_report(self, end: SimulatedSocket, data: bytes) -> None:
        """Delay a report of a node in `_stale`, and count the late answer that follows it."""
        machine, node = self._machine, end.owner
        if node not in self._stale or end.other is None or end.other.owner is not machine.caller:
            return
        kind = kind_of(data)
        if kind is FrameKind.REPORT and end.held_until_s <= machine.now_s:
            end.held_until_s = machine.now_s + self._drawn.uniform(*STALE_S)
        elif kind is FrameKind.PONG and end.held_until_s > machine.now_s:
            self.injected[Fault.STALE_HEARTBEAT] += 1
            self._stale.discard(node)


def kind_of(data: bytes) -> FrameKind | None:
    """Return the kind of a frame; None if the bytes are not the start of a frame."""
    if data[: len(MAGIC)] != MAGIC:
        return None
    return FrameKind(int.from_bytes(data[len(MAGIC) + 2 : len(MAGIC) + 4], "little"))


def counts_by_name(counts: Iterable[tuple[Fault, int]]) -> dict[str, int]:
    """Return counts by the names of faults, in the order of `Fault`."""
    found = dict(counts)
    return {str(fault): found[fault] for fault in Fault if found.get(fault)}


# The position of a change is drawn as a share of the frame, so that the length of a frame does not
# affect further random numbers.


def _damaged(drawn: random.Random, data: bytes) -> list[bytes]:
    changed = bytearray(data)
    size = min(len(data), HEAD_BYTES) if drawn.random() < 0.5 else len(data)
    changed[int(drawn.random() * size)] ^= 1 << int(drawn.random() * 8)
    return [bytes(changed)]


def _split(drawn: random.Random, data: bytes) -> list[bytes]:
    at = int(drawn.random() * len(data))
    return [data[:at], data[at:]]


def _lost(drawn: random.Random, data: bytes) -> list[bytes]:
    return []


def _doubled(drawn: random.Random, data: bytes) -> list[bytes]:
    return [data, data]
