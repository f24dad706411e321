"""`SimulatedMachine`: simulated processes and a simulated network in one real process.

Each simulated process is a thread; one thread runs at a time. A seed determines the order of
processes, the delays of bytes, and the faults. Time is a number that advances when all processes
wait. A process can be ended or stopped wherever it sends or waits.
"""

from __future__ import annotations

import heapq
import random
import select
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from itertools import count
from typing import Any

from cavmarl.core.errors import MessageError
from cavmarl.engine.world_setup import World
from cavmarl.parallel.network.transport import (
    Bytes,
    Connection,
    Place,
    TransportListener,
    TransportPoll,
)
from cavmarl.parallel.nodes.leases import late_ticks
from cavmarl.parallel.nodes.node_system import NodeSystem
from cavmarl.parallel.worlds.journaled_worlds import without_journals
from cavmarl.parallel.worlds.local_worlds import LocalWorlds

ADDRESS = "node"
ALIVE_S = 25.0  # time without an answer, after which the system ends a connection
LATEST_S = 0.002  # longest delay of bytes
JOIN_S = 5.0  # time for a thread to end
MAX_MOVES = 2_000_000  # limit of the total number of turns of all processes in a run


class ProcessEndedError(BaseException):
    """Unwinds the thread of a process that another process has ended."""


class SimulatedProcess:
    """A process of a simulated machine.

    Attributes:
        slowness_s: longest extra delay of each turn of the process.
        lag_s: extra delay of the next turn only.
        clock: offset of the process's clock at time 0 of the machine, and rate of this clock.
        on_send: called with each frame before it is sent; returns the number of bytes that are
            sent before the process dies, or None if it does not die.
    """

    def __init__(self, machine: SimulatedMachine, name: str) -> None:
        self.name = name
        self.slowness_s = self.lag_s = 0.0
        self.clock = (0.0, 1.0)
        self.is_ended = self.is_done = False
        self.stopped_until_s = 0.0
        self.ready: Callable[[], bool] = lambda: True
        self.until_s: float | None = None
        self.not_before_s = 0.0
        self.baton = threading.Semaphore(0)
        self.sockets: list[SimulatedSocket | SimulatedListener] = []
        self.on_send: Callable[[bytes], int | None] = lambda data: None
        self.failure: BaseException | None = None
        self.newest_received = -1  # highest number of a received frame; frames are numbered as sent
        self._machine = machine

    def clock_s(self) -> float:
        first_s, rate = self.clock
        return first_s + rate * self._machine.now_s

    def set_clock(self, jump_s: float, rate: float) -> None:
        """Let the clock jump forward and then advance at another rate."""
        self.clock = self.clock_s() + jump_s - rate * self._machine.now_s, rate

    def runs_at_s(self, now_s: float) -> float | None:
        """Return the time when the process continues; None: it continues only after an event."""
        first_s = max(self.stopped_until_s, self.not_before_s, now_s)
        if self.is_ended or self.ready():
            return now_s if self.is_ended else first_s
        return None if self.until_s is None else max(self.until_s, first_s)


class SimulatedMachine:
    """Simulated processes, their connections and the simulated time.

    Attributes:
        caller: the process of the thread that made the machine.
        now_s: the current time.
        before_send: called with a socket and a frame before the socket sends the frame.
        stuck: the reason why the processes cannot continue; empty if they can.
    """

    def __init__(self, seed: int, world: World) -> None:
        self.random = random.Random(seed)
        self.now_s = 0.0
        self.world = world
        self.listeners: dict[Place, SimulatedListener] = {}
        self.processes: list[SimulatedProcess] = []
        self.numbers = count(100)  # numbers of sockets
        self.connections: list[tuple[SimulatedSocket, SimulatedSocket]] = []
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._moves = count()  # counts the turns of all processes
        self._event_numbers = count()  # these numbers keep the order of simultaneous events
        self._threads: list[threading.Thread] = []
        self.frames = count()
        self.before_send: Callable[[SimulatedSocket, bytes], None] = lambda end, data: None
        self.stuck = ""
        self.caller = self.running = self._new("caller")

    def _new(self, name: str) -> SimulatedProcess:
        process = SimulatedProcess(self, name)
        self.processes.append(process)
        return process

    def system(self, process: SimulatedProcess) -> NodeSystem:
        return _System(self, process)

    def start(self, name: str, run: Callable[[NodeSystem], None]) -> SimulatedProcess:
        """Start a process, which runs when other processes wait."""
        process = self._new(name)

        def run_and_finish() -> None:
            process.baton.acquire()
            try:
                if not process.is_ended:
                    run(self.system(process))
            except ProcessEndedError:
                pass
            except BaseException as error:
                process.failure = error
            finally:
                self._finish(process)

        thread = threading.Thread(target=run_and_finish, daemon=True)
        self._threads.append(thread)
        thread.start()
        return process

    def _finish(self, process: SimulatedProcess) -> None:
        for one in process.sockets:
            one.close()
        process.is_done = True
        self.processes.remove(process)
        following = self._next()
        self.running = following
        following.baton.release()

    def at(self, delay_s: float, act: Callable[[], None]) -> None:
        """Call `act` after `delay_s` simulated seconds."""
        self.at_time(self.now_s + delay_s, act)

    def at_time(self, time_s: float, act: Callable[[], None]) -> None:
        """Call `act` at a simulated time; simultaneous calls keep their order."""
        heapq.heappush(self._events, (time_s, next(self._event_numbers), act))

    def end(self, process: SimulatedProcess) -> None:
        """End a process and its connections, like SIGKILL."""
        if not process.is_done:
            process.is_ended = True
            for one in process.sockets:
                one.close()

    def wait(
        self, process: SimulatedProcess, ready: Callable[[], bool], until_s: float | None
    ) -> None:
        """Let other processes run until `ready` returns true, or until a time."""
        if process.is_ended:
            raise ProcessEndedError
        process.ready, process.until_s = ready, until_s
        longer_s, process.lag_s = process.lag_s, 0.0
        process.not_before_s = self.now_s + longer_s + process.slowness_s * self.random.random()
        following = self._next()
        if following is not process:
            self.running = following
            following.baton.release()
            process.baton.acquire()
        if self.stuck and process is self.caller:
            raise AssertionError(self.stuck)
        if process.is_ended:
            raise ProcessEndedError

    def _next(self) -> SimulatedProcess:
        """Advance the time and return the next process; if none can run, return the caller."""
        while True:
            if next(self._moves) > MAX_MOVES:
                self.stuck = f"the processes have not ended after {MAX_MOVES} turns"
                return self.caller
            times = [(one.runs_at_s(self.now_s), one) for one in self.processes]
            due = [one for at_s, one in times if at_s is not None and at_s <= self.now_s]
            if due:
                return due[0] if len(due) == 1 else self.random.choice(due)
            coming = [at_s for at_s, _ in times if at_s is not None]
            if self._events:
                coming.append(self._events[0][0])
            if not coming:
                self.stuck = "all processes wait forever"
                return self.caller
            self.now_s = max(self.now_s, min(coming))
            while self._events and self._events[0][0] <= self.now_s:
                heapq.heappop(self._events)[2]()

    def outlived(self, patience_s: float) -> list[str]:
        """Return the names of processes that still run `patience_s` after the caller has ended."""
        caller, until_s = self.caller, self.now_s + patience_s
        caller.is_ended = False
        for one in caller.sockets:
            one.close()
        self.wait(caller, lambda: len(self.processes) == 1, until_s)
        return [process.name for process in self.processes if process is not caller]

    def close(self) -> None:
        """End all processes except the caller."""
        self.stuck, self._moves = "", count()
        for process in list(self.processes):
            if process is not self.caller:
                self.end(process)
        self.wait(self.caller, lambda: len(self.processes) == 1, None)
        for thread in self._threads:
            thread.join(JOIN_S)
            if thread.is_alive():
                raise AssertionError(f"a process does not end within {JOIN_S:g} s")


class SimulatedSocket:
    """A `Connection` in memory.

    `Link` sends a complete frame with each call of `send`.

    Attributes:
        due: fault of the next frame: a function that returns the pieces to be delivered.
        on_arrival: called when the next frame arrives; the argument is true if the receiver already
            has a frame that was sent later over another connection.
        held_until_s: no bytes in this direction arrive before this time.
        is_mute: whether no sent bytes arrive, without notice to the sender.
    """

    address, keeps_bytes = ADDRESS, False

    def __init__(self, machine: SimulatedMachine, owner: SimulatedProcess) -> None:
        self._machine, self.owner = machine, owner
        self._number = next(machine.numbers)
        self.other: SimulatedSocket | None = None
        self.received: deque[bytes] = deque()
        self.has_ended = self.is_closed = self.is_mute = False
        self.due: Callable[[bytes], list[bytes]] | None = None
        self.on_arrival: Callable[[bool], None] | None = None
        self.held_until_s = 0.0
        self._last_s = 0.0
        owner.sockets.append(self)

    def fileno(self) -> int:
        return self._number

    @property
    def closed(self) -> bool:
        return self.has_ended and not self.received

    def send(self, pieces: Sequence[Bytes]) -> int:
        machine, data = self._machine, b"".join(map(bytes, pieces))
        if self.owner.is_ended:
            raise ProcessEndedError
        if self.is_closed or self.has_ended:
            raise BrokenPipeError
        machine.before_send(self, data)
        sent = self.owner.on_send(data)
        if self.is_closed or self.has_ended:  # a fault has closed it
            raise BrokenPipeError
        change, self.due = self.due, None
        arrived, self.on_arrival = self.on_arrival, None
        number = next(machine.frames)
        chunks = [data if sent is None else data[:sent]]
        if change is not None:
            chunks = change(chunks[0])
        for chunk in [] if self.is_mute else chunks:
            self._deliver(chunk, number, arrived)
        if sent is not None:
            machine.end(self.owner)
            raise ProcessEndedError
        return len(data)

    def fall_silent(self) -> None:
        """Deliver no more bytes in this direction. Both ends close after `ALIVE_S`."""
        assert self.other is not None
        self.is_mute = True
        for end in (self, self.other):
            self._machine.at(ALIVE_S, end.break_off)

    def break_off(self) -> None:
        self.has_ended = True

    def _deliver(
        self,
        chunk: bytes | None,  # None: the end of the connection
        number: int = -1,  # number of the frame
        arrived: Callable[[bool], None] | None = None,  # see `on_arrival`
    ) -> None:
        """Deliver bytes after a delay, and after all bytes sent before."""
        machine, other = self._machine, self.other
        assert other is not None
        at_s = max(machine.now_s, self.held_until_s) + machine.random.uniform(0.0, LATEST_S)
        self._last_s = max(self._last_s, at_s)

        def arrive() -> None:
            if chunk is None:
                other.has_ended = True
            elif chunk:
                other.received.append(chunk)
                receiver = other.owner
                if arrived is not None:
                    arrived(receiver.newest_received > number)
                receiver.newest_received = max(receiver.newest_received, number)

        # `now_s` plus the delay could round to a time before the arrival of earlier bytes.
        machine.at_time(self._last_s, arrive)

    def receive(self, room: memoryview) -> int:
        if not self.received:
            return 0
        chunk = self.received.popleft()
        size = min(len(room), len(chunk))
        room[:size] = chunk[:size]
        if size < len(chunk):
            self.received.appendleft(chunk[size:])
        return size

    def is_readable(self) -> bool:
        return bool(self.received) or self.has_ended

    def close(self) -> None:
        if not self.is_closed:
            self.is_closed = True
            if not self.is_mute:
                self._deliver(None)


class SimulatedListener:
    """A simulated `Listener`, for callers that have proved that they know the secret."""

    def __init__(self, machine: SimulatedMachine, owner: SimulatedProcess) -> None:
        self.place: Place = (ADDRESS, next(machine.numbers))
        self.secret = bytes(32)
        self._machine, self.owner = machine, owner
        self.callers: list[tuple[int, SimulatedSocket]] = []
        machine.listeners[self.place] = self
        owner.sockets.append(self)

    def fileno(self) -> int:
        return self.place[1]

    def is_readable(self) -> bool:
        return bool(self.callers)

    def admit(self) -> list[tuple[int, Connection]]:
        found, self.callers = self.callers, []
        return [*found]

    def close(self) -> None:
        self._machine.listeners.pop(self.place, None)
        for _, one in self.callers:
            one.close()


class _Poll:
    """A simulated `select.poll` that only waits for input; output never waits."""

    def __init__(self, machine: SimulatedMachine, process: SimulatedProcess) -> None:
        self._machine, self._process = machine, process
        self._registered: dict[int, SimulatedSocket | SimulatedListener] = {}

    def register(self, one: Any, events: int) -> None:
        self._registered[one.fileno()] = one

    def modify(self, one: Any, events: int) -> None:
        self._registered[one.fileno()] = one

    def unregister(self, one: Any) -> None:
        del self._registered[one.fileno()]

    def _ready(self) -> list[tuple[int, int]]:
        return [(n, select.POLLIN) for n, one in self._registered.items() if one.is_readable()]

    def poll(self, timeout_ms: float | None) -> list[tuple[int, int]]:
        machine, (_, rate) = self._machine, self._process.clock
        until_s = None if timeout_ms is None else machine.now_s + 1e-3 * timeout_ms / rate
        machine.wait(self._process, lambda: bool(self._ready()), until_s)
        return self._ready()


class _System:
    """The `NodeSystem` of a process."""

    looks = 0  # no busy waiting, because sleep costs no simulated time

    def __init__(self, machine: SimulatedMachine, process: SimulatedProcess) -> None:
        self._machine, self._process = machine, process

    def now_s(self) -> float:
        return self._process.clock_s()

    def poll(self) -> TransportPoll:
        return _Poll(self._machine, self._process)

    def listen(self, address: str, secret: bytes) -> TransportListener:
        return SimulatedListener(self._machine, self._process)

    def open(self, place: Place, secret: bytes, number: int, answer_s: float | None) -> Connection:
        machine = self._machine
        listener = machine.listeners.get((str(place[0]), int(place[1])))
        if listener is None or listener.owner.is_ended:
            raise ConnectionRefusedError(f"nothing listens at {place}")
        if secret != listener.secret:
            raise MessageError(f"the listener at {place} has a different secret")
        here, there = (SimulatedSocket(machine, each) for each in (self._process, listener.owner))
        here.other, there.other = there, here
        machine.connections.append((here, there))
        listener.callers.append((number, there))
        return here

    def worlds_of(
        self, message: Mapping[str, Any], trouble: str, num_worlds: int, in_next_step: bool
    ) -> LocalWorlds:
        world = self._machine.world
        late = late_ticks(world.config)
        world = without_journals(world)
        return LocalWorlds(world, num_worlds, in_next_step=in_next_step, late_ticks=late)
