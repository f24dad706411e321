"""`TimeMaster` alone advances the time of an environment; `TimeFollower` reads it.

Time is an integer number of ticks, and time = tick · Δt: after 5,000 ticks of 50 ms it is exactly
250.0. A master replaces the environment's worlds by a guard, so that no other caller can step or
reset them. Without a master there is no overhead. Followers may join and leave while the world
runs. If a follower tries to advance the world itself, the master refuses the tick, ignores it, or
obeys it, and counts it. Obeying reproduces a fault of the co-simulation paper, in which the world
advanced 1.92 times as fast as its master. Ticks without the master are detected before its next
step.

A `Pacer` paces steps by the wall clock; simulated time does not depend on it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import ClockError, ConfigError
from cavmarl.cosim.deadline_watch import DeadlineWatch
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.step_trace import StepTrace
from cavmarl.shards.shard import Commands


class Pacer(Protocol):
    """Determines when the next step may begin."""

    def wait(self, elapsed_s: float) -> None:
        """Wait until the step that starts after `elapsed_s` of simulated time may begin."""
        ...


class Unpaced:
    """Begins each step as soon as the previous step has ended."""

    def wait(self, elapsed_s: float) -> None:
        """Return at once."""


@dataclass(frozen=True)
class Lateness:
    """The delay of steps, by the wall clock."""

    steps: int  # number of steps
    # number of steps that began after they were due, because earlier steps took too long
    late: int
    mean_wall_s: float  # mean delay of all steps
    worst_wall_s: float  # maximum delay


class RealTime:
    """Runs simulated time at `factor` times the wall clock, or slower if necessary.

    A step is due at a fixed time after the first one began, so that delays are caught up and do not
    accumulate.

    `factor`: simulated seconds per second. `now`: the wall clock in seconds. `sleep`: waits for a
    number of seconds. `deadline_s`: time after a step is due at which its controls have to be
    queued; None: no deadline. A missed deadline is counted and does not change results.

    Attributes:
        watch: counts missed deadlines; None: no deadline.

    Raises ConfigError: the factor or the deadline is not a finite number above 0.
    """

    def __init__(
        self,
        factor: float = 1.0,
        now: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
        deadline_s: float | None = None,
    ) -> None:
        if not 0.0 < factor < float("inf"):
            raise ConfigError(f"pacing by {factor}: must be a number above 0, such as 1 or 2.5")
        self._factor = factor
        self._now, self._sleep = now, sleep
        self._origin: float | None = None
        self._steps = self._late = 0
        self._sum_s = self._worst_s = 0.0
        self.watch = None if deadline_s is None else DeadlineWatch(deadline_s, now)

    def wait(self, elapsed_s: float) -> None:
        if self.watch is not None:
            self.watch.end()
        now = self._now()
        if self._origin is None:
            self._origin = now - elapsed_s / self._factor
        early_s = self._origin + elapsed_s / self._factor - now
        if early_s > 0.0:
            self._sleep(early_s)
            early_s = self._origin + elapsed_s / self._factor - self._now()
        elif early_s < 0.0:
            self._late += 1
        late_s = max(0.0, -early_s)
        self._steps += 1
        self._sum_s += late_s
        self._worst_s = max(self._worst_s, late_s)
        if self.watch is not None:
            self.watch.begin(self._origin + elapsed_s / self._factor)

    @property
    def lateness(self) -> Lateness:
        mean_s = self._sum_s / max(self._steps, 1)
        return Lateness(self._steps, self._late, mean_s, self._worst_s)


class Stepwise:
    """Waits for permission before each step.

    Args:
        ask: called with the simulated time in seconds before each step, which begins when it
            returns.
    """

    def __init__(self, ask: Callable[[float], object]) -> None:
        self._ask = ask

    def wait(self, elapsed_s: float) -> None:
        self._ask(elapsed_s)


OwnTicks = Literal["refuse", "ignore", "obey"]

KEPT_EVENTS = 10_000


class _Worlds(Protocol):
    """The part of `step_arrays.SteppedWorlds` that a master needs."""

    @property
    def simulation(self) -> Simulation: ...

    def ticks(self) -> NDArray[np.int64]: ...

    def step(self, commands: Commands) -> None: ...

    def reset(self, seed: int | None, first_world: int) -> None: ...


class Steppable(Protocol):
    """A `CavEnv` or a `CavVectorEnv`."""

    config: EnvConfig
    worlds: Any

    def step(self, actions: Any) -> Any: ...

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any: ...


class ClockEvent(NamedTuple):
    """An attempt of another caller to advance the world, successful or not."""

    tick: int  # the master's tick at detection
    # `own_tick`: a follower tried to tick; `drift`: a world was advanced without its master
    kind: Literal["own_tick", "drift"]
    follower: str  # name of the follower; empty for a drift
    ticks: int  # number of ticks by which the world was or would have been advanced


@dataclass
class TimeFollower:
    """Reads the master's clock, in this process or at the other end of a socket."""

    master: TimeMaster  # the master of the clock
    name: str
    own_ticks: int = 0  # number of ticks that it has requested

    @property
    def time_s(self) -> float:
        return self.master.time_s

    def tick(self) -> bool:
        """Try to advance the world; return whether it has advanced.

        Raises ClockError: the master refuses, see `TimeMaster`; or the follower has left.
        """
        self.master.check_follower(self)
        self.own_ticks += 1
        return self.master.tick_for(self)

    def leave(self) -> None:
        self.master.let_go(self)


class _GuardedWorlds:
    """Guards an environment's worlds: only their master can step and reset them."""

    def __init__(self, worlds: _Worlds, master: TimeMaster) -> None:
        self.worlds = self.guarded = worlds  # `guarded`: see `env.drawn_worlds.unguarded`
        self._master = master

    def __getattr__(self, name: str) -> Any:
        return getattr(self.worlds, name)

    def step(self, commands: Commands) -> None:
        self._master.check_turn("step")
        self._master.advance(self.worlds, commands)

    def reset(self, seed: int | None, first_world: int) -> None:
        self._master.check_turn("reset")
        self.worlds.reset(seed, first_world)
        self._master.set_back(self.worlds)


class TimeMaster:
    """The only caller that advances time.

    Args:
        env: a `CavEnv` or a `CavVectorEnv`; until `release` only `TimeMaster.step` and
            `TimeMaster.reset` step and reset it.
        pacer: pace by the wall clock; None: as fast as possible.
        own_ticks: handling of a follower's own tick: `refuse`: raise an error in the follower's
            call; `ignore`: do nothing; `obey`: advance the world with the controls of the last
            step, which is the fault of the unprotected co-simulation.
        on_drift: handling of a world that another caller has advanced: `error`: raise an error
            before the next step; `record`: record an event and continue.
        trace: records the phases of each step; only for worlds in this process.

    Attributes:
        tick: ticks by this master; not changed by resets.
        events: the first events; later ones are only counted.
        own_ticks: number of all followers' own ticks.
        drifts: number of detected drifts.
        drift_ticks: number of ticks by which the first world was advanced without the master.
        watch: counts missed deadlines; None: the pacer has no deadline.

    Raises:
        ClockError: the environment already has a master.
        ConfigError: a trace is given for worlds in other processes.
    """

    def __init__(
        self,
        env: Steppable,
        *,
        pacer: Pacer | None = None,
        own_ticks: OwnTicks = "refuse",
        on_drift: Literal["error", "record"] = "error",
        trace: StepTrace | None = None,
    ) -> None:
        if isinstance(env.worlds, _GuardedWorlds):
            raise ClockError(
                "this environment has a time master already; follow it (TimeMaster.follow), or "
                "release it first (TimeMaster.release)"
            )
        self.env = env
        self.dt_s = env.config.clock.sim_dt_s
        self.tick = 0
        self.events: list[ClockEvent] = []
        self.own_ticks = self.drifts = self.drift_ticks = 0
        self._pacer = Unpaced() if pacer is None else pacer
        self.watch = pacer.watch if isinstance(pacer, RealTime) else None
        self._answer, self._on_drift, self._trace = own_ticks, on_drift, trace
        self._per_step = env.config.clock.ticks_per_step
        self._followers: list[TimeFollower] = []
        self._is_turn = False
        self._last: Commands | None = None
        worlds: _Worlds = env.worlds
        if trace is not None:
            worlds.simulation.trace(trace.around, trace.note)
        self._left = worlds.ticks()
        self._guard = env.worlds = _GuardedWorlds(worlds, self)

    @property
    def time_s(self) -> float:
        return self.tick * self.dt_s

    @property
    def world_ticks(self) -> NDArray[np.int64]:
        """(W,) ticks of each world since its reset, made by any caller."""
        return self._guarded_worlds().ticks()

    @property
    def followers(self) -> tuple[TimeFollower, ...]:
        return tuple(self._followers)

    def follow(self, name: str) -> TimeFollower:
        """Add a follower; this does not change the world."""
        follower = TimeFollower(self, name)
        self._followers.append(follower)
        return follower

    def let_go(self, follower: TimeFollower) -> None:
        self._followers.remove(follower)

    def step(self, actions: Any) -> Any:
        """Advance the environment by one step; return the result of its `step`.

        Raises ClockError: another caller has advanced a world.
        """
        with self._turn():
            return self.env.step(actions)

    def reset(self, seed: int | None = None, options: Mapping[str, Any] | None = None) -> Any:
        """Begin an episode; return the result of the environment's `reset`."""
        with self._turn():
            return self.env.reset(seed=seed, options=None if options is None else dict(options))

    def release(self) -> None:
        """Release the environment, which can then be stepped without a master."""
        self.env.worlds = self._guarded_worlds()
        self._followers.clear()

    @contextmanager
    def _turn(self) -> Iterator[None]:
        self._guarded_worlds()
        self._is_turn = True
        try:
            yield
        finally:
            self._is_turn = False

    def _guarded_worlds(self) -> _Worlds:
        """Return the guarded worlds.

        Raises ClockError: they have been released.
        """
        if self.env.worlds is not self._guard:
            raise ClockError("this master has been released; make another TimeMaster")
        worlds: _Worlds = self._guard.worlds
        return worlds

    def check_turn(self, what: str) -> None:
        """Check that the caller is the master.

        Raises ClockError: `what` was called on the environment itself.
        """
        if not self._is_turn:
            raise ClockError(
                f"{what}() of an environment that has a time master; call TimeMaster.{what}(), or "
                "release the environment first (TimeMaster.release)"
            )

    def check_follower(self, follower: TimeFollower) -> None:
        """Check that a follower still follows.

        Raises ClockError: the follower has left, or the master was released.
        """
        if follower not in self._followers:
            raise ClockError(f"'{follower.name}' no longer follows; join again (TimeMaster.follow)")

    def advance(self, worlds: _Worlds, commands: Commands) -> None:
        """Check for drift, wait for the pacer, step the worlds, and count the ticks."""
        self.look_for_drift()
        self._pacer.wait(self.time_s)
        if self._trace is not None:
            self._trace.begin()
        worlds.step(commands)
        self._last = commands
        self._left = worlds.ticks()
        self.tick += self._per_step

    def set_back(self, worlds: _Worlds) -> None:
        """Store the ticks of worlds that the master has reset."""
        self._left = worlds.ticks()
        self._last = None

    def look_for_drift(self) -> None:
        """Detect worlds that another caller has advanced since the last step.

        Raises ClockError: there are some, and `on_drift` is `error`.
        """
        found = self._guarded_worlds().ticks()
        if (found == self._left).all():
            return
        (drifted,) = np.nonzero(found != self._left)
        world = int(drifted[0])
        extra = int(found[world] - self._left[world])
        self.drifts += 1
        self._keep(ClockEvent(self.tick, "drift", "", extra))
        self.drift_ticks += int(found[0] - self._left[0])
        left, self._left = self._left, found
        if self._on_drift == "error":
            raise ClockError(
                f"world {world} is at tick {found[world]}, but its time master left it at "
                f"{left[world]}: another caller ticks it; let that caller follow the master, or "
                "set on_drift = record"
            )

    def tick_for(self, follower: TimeFollower) -> bool:
        """Handle a follower's own tick; return whether the world has advanced.

        Raises ClockError: `own_ticks` is `refuse`.
        """
        self.own_ticks += 1
        self._keep(ClockEvent(self.tick, "own_tick", follower.name, self._per_step))
        if self._answer == "refuse":
            raise ClockError(
                f"follower '{follower.name}' ticks by itself at {self.time_s:g} s, but only the "
                "time master may tick; switch its own ticks off, or set own_ticks = ignore"
            )
        if self._answer == "ignore" or self._last is None:
            return False
        self._guarded_worlds().step(self._last)
        return True

    def _keep(self, event: ClockEvent) -> None:
        if len(self.events) < KEPT_EVENTS:
            self.events.append(event)
