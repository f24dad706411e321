"""`TimeMaster` alone advances the time of an environment; `TimeFollower` reads it.

The integer tick is the truth, and time = tick · Δt: after 5,000 ticks of 50 ms it is exactly 250.0.
A master takes the place of the environment's worlds, so that from then on no other caller steps or
resets them; an environment without a master pays nothing for that. Followers come and go while the
world runs. What one of them does when it ticks by itself, which made the world of the
co-simulation paper advance 1.92 times as fast as its master, is refused, ignored or, to show the
fault, obeyed; each is counted, and what has passed the master by is noticed before his next step.

A `Pacer` paces steps on the wall clock; simulated time does not depend on it.
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
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.step_trace import StepTrace
from cavmarl.shards.shard import Commands


class Pacer(Protocol):
    """Says when the next step may begin."""

    def wait(self, elapsed_s: float) -> None:
        """Return when the step may begin that starts after `elapsed_s` of simulated time."""
        ...


class Unpaced:
    """A step begins as soon as the one before has ended."""

    def wait(self, elapsed_s: float) -> None:
        """Go on at once."""


@dataclass(frozen=True)
class Lateness:
    """How late steps began, by the wall clock."""

    steps: int  # that have begun
    # of these, that could not begin when they were due, because what went before took too long
    late: int
    mean_wall_s: float  # how long after they were due all of them began, on average
    worst_wall_s: float  # the same, of the worst


class RealTime:
    """Simulated time goes on `factor` times as fast as the wall clock, or slower if it has to.

    A step is due at a fixed time after the first one began, so that lateness is made up for and
    does not add up.

    `factor`: seconds of simulated time a second. `now`: the wall clock in seconds. `sleep`: waits
    so many seconds.

    Raises ConfigError: a factor that is no number above 0.
    """

    def __init__(
        self,
        factor: float = 1.0,
        now: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        if not 0.0 < factor < float("inf"):
            raise ConfigError(f"pacing by {factor}: must be a number above 0, as 1 or 2.5")
        self._factor = factor
        self._now, self._sleep = now, sleep
        self._origin: float | None = None
        self._steps = self._late = 0
        self._sum_s = self._worst_s = 0.0

    def wait(self, elapsed_s: float) -> None:
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

    @property
    def lateness(self) -> Lateness:
        mean_s = self._sum_s / max(self._steps, 1)
        return Lateness(self._steps, self._late, mean_s, self._worst_s)


class Stepwise:
    """Each step waits for permission.

    Args:
        ask: called with the simulated time in seconds before each step; the step begins when it
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
    """Something about time that should not have been."""

    tick: int  # the master's when it was noticed
    # `own_tick`: a follower wanted to tick; `drift`: a world is not where its master left it
    kind: Literal["own_tick", "drift"]
    follower: str  # its name; unknown for a drift
    ticks: int  # by how many the world has gone on, or would have


@dataclass
class TimeFollower:
    """Reads the master's clock, in this process or at the other end of a socket."""

    master: TimeMaster  # whose clock it reads
    name: str
    since_tick: int  # the master's when it has joined
    own_ticks: int = 0  # how often it has wanted to tick by itself

    @property
    def time_s(self) -> float:
        return self.master.time_s

    def tick(self) -> bool:
        """Try to advance the world; whether it has advanced.

        Raises ClockError: the master refuses; see `TimeMaster`; it is no follower any more.
        """
        self.master.check_follower(self)
        self.own_ticks += 1
        return self.master.tick_for(self)

    def leave(self) -> None:
        self.master.let_go(self)


class _Mastered:
    """Stands for an environment's worlds: steps and resets them for their master only."""

    def __init__(self, worlds: _Worlds, master: TimeMaster) -> None:
        self.worlds = worlds
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
        pacer: how fast by the wall clock; None: as fast as it goes.
        own_ticks: what becomes of a follower's own tick: `refuse`: an error where it was called;
            `ignore`: nothing happens; `obey`: the world really goes on, with the controls of the
            last step. That is the fault of the unprotected co-simulation.
        on_drift: what becomes of a world that is not where the master has left it: `error`, before
            the next step; `record`: an event, and it goes on from there.
        trace: notes the phases of each step; of worlds in this process only.

    Attributes:
        tick: ticks by this master; no reset sets it back.
        events: the first ones; of those that follow only the counts are kept.
        own_ticks: how often all followers wanted to tick by themselves.
        drifts: how often a world was not where the master had left it.
        drift_ticks: by how many ticks the first world has gone on without the master.

    Raises:
        ClockError: the environment has a master.
        ConfigError: a trace of worlds in other processes.
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
        if isinstance(env.worlds, _Mastered):
            raise ClockError(
                "this environment has a time master already: follow it (TimeMaster.follow), or let "
                "it go first (TimeMaster.release)"
            )
        self.env = env
        self.dt_s = env.config.clock.sim_dt_s
        self.tick = 0
        self.events: list[ClockEvent] = []
        self.own_ticks = self.drifts = self.drift_ticks = 0
        self._pacer = Unpaced() if pacer is None else pacer
        self._answer, self._on_drift, self._trace = own_ticks, on_drift, trace
        self._per_step = env.config.clock.ticks_per_step
        self._followers: list[TimeFollower] = []
        self._is_turn = False
        self._last: Commands | None = None
        worlds: _Worlds = env.worlds
        if trace is not None:
            worlds.simulation.trace(trace.around, trace.note)
        self._left = worlds.ticks()
        self._mastered = env.worlds = _Mastered(worlds, self)

    @property
    def time_s(self) -> float:
        return self.tick * self.dt_s

    @property
    def world_ticks(self) -> NDArray[np.int64]:
        """(W,) ticks of each world since its reset, made by any caller."""
        return self._mine().ticks()

    @property
    def followers(self) -> tuple[TimeFollower, ...]:
        return tuple(self._followers)

    def follow(self, name: str) -> TimeFollower:
        """Add a follower from now on; nothing of the world changes by it."""
        follower = TimeFollower(self, name, self.tick)
        self._followers.append(follower)
        return follower

    def let_go(self, follower: TimeFollower) -> None:
        self._followers.remove(follower)

    def step(self, actions: Any) -> Any:
        """Advance the environment by one step; returns what its `step` returns.

        Raises ClockError: a world is not where the last step has left it.
        """
        with self._turn():
            return self.env.step(actions)

    def reset(self, seed: int | None = None, options: Mapping[str, Any] | None = None) -> Any:
        """Begin an episode; returns what the environment's `reset` returns."""
        with self._turn():
            return self.env.reset(seed=seed, options=None if options is None else dict(options))

    def release(self) -> None:
        """Be master no longer: the environment can be stepped as before."""
        self.env.worlds = self._mine()
        self._followers.clear()

    @contextmanager
    def _turn(self) -> Iterator[None]:
        self._mine()
        self._is_turn = True
        try:
            yield
        finally:
            self._is_turn = False

    def _mine(self) -> _Worlds:
        """The worlds behind the guard.

        Raises ClockError: they have been let go.
        """
        if self.env.worlds is not self._mastered:
            raise ClockError("this master has been released: make another TimeMaster")
        worlds: _Worlds = self._mastered.worlds
        return worlds

    def check_turn(self, what: str) -> None:
        """Refuse a caller that is not the master.

        Raises ClockError: `what` was called on the environment itself.
        """
        if not self._is_turn:
            raise ClockError(
                f"{what}() of an environment that has a time master: call TimeMaster.{what}(), or "
                "let the environment go first (TimeMaster.release)"
            )

    def check_follower(self, follower: TimeFollower) -> None:
        """Refuse a follower that does not follow any more.

        Raises ClockError: it has left, or the master was released.
        """
        if follower not in self._followers:
            raise ClockError(f"'{follower.name}' follows no more: join again (TimeMaster.follow)")

    def advance(self, worlds: _Worlds, commands: Commands) -> None:
        """One step of the worlds: look for drift, wait for its time, step, count."""
        self.look_for_drift()
        self._pacer.wait(self.time_s)
        if self._trace is not None:
            self._trace.begin()
        worlds.step(commands)
        self._last = commands
        self._left = worlds.ticks()
        self.tick += self._per_step

    def set_back(self, worlds: _Worlds) -> None:
        """Worlds have begun anew, by the master."""
        self._left = worlds.ticks()
        self._last = None

    def look_for_drift(self) -> None:
        """Notice worlds that are not where the last step has left them.

        Raises ClockError: there are some, and `on_drift` is `error`.
        """
        found = self._mine().ticks()
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
                f"{left[world]}: another caller ticks it; let that follow the master, or ask for "
                "on_drift = record"
            )

    def tick_for(self, follower: TimeFollower) -> bool:
        """A follower wants to tick by itself; whether the world has advanced.

        Raises ClockError: `own_ticks` is `refuse`.
        """
        self.own_ticks += 1
        self._keep(ClockEvent(self.tick, "own_tick", follower.name, self._per_step))
        if self._answer == "refuse":
            raise ClockError(
                f"follower '{follower.name}' ticks by itself at {self.time_s:g} s: only the time "
                "master ticks; switch its own ticks off, or ask for own_ticks = ignore"
            )
        if self._answer == "ignore" or self._last is None:
            return False
        self._mine().step(self._last)
        return True

    def _keep(self, event: ClockEvent) -> None:
        if len(self.events) < KEPT_EVENTS:
            self.events.append(event)
