"""`StepSession`: the worlds that an environment steps, with the inputs and outputs of a step."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import ConfigError, EpisodeError
from cavmarl.core.seeds import check_seed, first_seed
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.vehicle_way import way_ahead
from cavmarl.engine.waiting_cycles import find_deadlocks
from cavmarl.engine.world_frame import WorldFrame, frame_of
from cavmarl.env.actions import ActionDecoder
from cavmarl.env.declared_events import DeclaredEvents
from cavmarl.env.drawn_worlds import WorldCopy, unguarded, vehicles_that_ended
from cavmarl.env.external_commands import ExternalCommands
from cavmarl.env.insertions import Insertions
from cavmarl.env.lane_changes import LaneChanges
from cavmarl.env.limit_agents import LimitAgents
from cavmarl.env.overridden_signals import SignalOverrides
from cavmarl.env.recorded_inputs import StepInputs
from cavmarl.env.recorded_worlds import Record, WorldRecorder
from cavmarl.env.signal_agents import SignalAgents
from cavmarl.limits.limit_controllers import make_limit_controller
from cavmarl.parallel.worlds.local_worlds import LocalWorlds, kept_elsewhere
from cavmarl.parallel.worlds.step_arrays import SteppedWorlds
from cavmarl.recordings.extra_tables import RecordOptions
from cavmarl.render.topdown import WorldView
from cavmarl.shards.shard import Commands
from cavmarl.signals.controllers import make_controller


class StepSession:
    """The running worlds of one environment.

    A step takes decoded actions and the waiting inputs: declared events, insertions, commands to
    external vehicles, overridden signals and changed lanes. After each reset and step, the session
    records the worlds and calls its watchers. A copy or a pickle of a session has its own worlds,
    which continue bit for bit; it has no recording and no watchers.

    Args:
        worlds: the worlds to step.
        in_place: whether actions are decoded into the arrays of the worlds.
        seed: seed of the first reset if that call has none.

    Attributes:
        worlds: the worlds to step.
        agents: ids of the agents of a world.
        decoder: decodes actions into commands.
        events: the events that agents have declared for the next step.
        insertions: vehicles for the next step.
        external: commands for the next step to vehicles that the caller poses or drives.
        overrides: signals that show the caller's states.
        lane_changes: lanes that the caller closes or slows down.
        controlled: the signals or limits that are controlled; None: there are none.
        roadside: the signals or limits if agents control them, else None.
        is_ready: whether `reset` has been called.
        simulated_s: wall time of all steps of the worlds so far.
    """

    def __init__(
        self, worlds: SteppedWorlds, *, in_place: bool = False, seed: int | None = None
    ) -> None:
        config, arrays = worlds.world.config, worlds.arrays
        num_worlds = len(arrays.mask)
        self.worlds = worlds
        self.agents = tuple(f"car_{k}" for k in range(config.population.num_ids))
        commands = Commands(arrays.controls, arrays.meta_actions) if in_place else None
        self.decoder = ActionDecoder(config.action, num_worlds, self.agents, commands)
        self.events = DeclaredEvents(config, num_worlds)
        network = worlds.world.network
        self.insertions = Insertions(config, network, num_worlds)
        self.external = ExternalCommands(config, network, num_worlds, self.without_sumo)
        self.overrides = SignalOverrides(config, network, num_worlds, self.present)
        self.lane_changes = LaneChanges(config, network, num_worlds, self.present)
        self.controlled = _controlled(config, worlds)
        self.roadside = None if config.roadside is None else self.controlled
        self._choose = _choices_of_controller(self.controlled, config)
        self.is_ready = False
        self._is_closed = False
        self.simulated_s = 0.0
        self._in_place = in_place
        self._first_seed = None if seed is None else check_seed(seed)
        self._copy = WorldCopy()
        self._recorder: WorldRecorder | None = None
        self._watchers: tuple[Callable[[], None], ...] = ()
        self._view: WorldView | None = None

    @property
    def config(self) -> EnvConfig:
        """The configuration of the worlds."""
        return self.worlds.world.config

    @property
    def is_watched(self) -> bool:
        """Whether a function is called after each reset and step."""
        return bool(self._watchers)

    def reset(self, seed: int | None, chosen: NDArray[np.bool_], first_world: int = 0) -> None:
        """Begin an episode in the chosen worlds (W,).

        If `seed` is None, the first reset uses the seed of the session; a later reset begins the
        next episodes of the last seed. Random numbers of world w depend on `first_world` + w.
        """
        self._refuse_closed("reset()")
        if seed is not None or not self.is_ready:
            seed = first_seed(seed, self._first_seed)
        self.worlds.arrays.chosen[:] = chosen
        self.worlds.reset(seed, first_world)
        self.forget(chosen)
        if self._recorder is not None:
            self._recorder.note(StepInputs(seed=seed))
        self.is_ready = True
        self._notify(chosen)

    def step(self, commands: Commands, signal_choices: NDArray[np.int64] | None = None) -> None:
        """Step the worlds with all waiting inputs. If the step fails, the inputs keep waiting."""
        began = time.perf_counter()
        if self._choose is not None:
            signal_choices = self._choose()
        if signal_choices is not None:
            commands = replace(commands, signal_choices=signal_choices)
        waiting = (
            self.events, self.insertions, self.external, self.overrides, self.lane_changes
        )  # fmt: skip
        if self.lane_changes.can_advance:
            self.lane_changes.advance(self._ticks_of_running())
        for part in waiting:
            commands = part.add_to(commands)
        self.worlds.step(commands)
        if self._recorder is not None:
            self._recorder.note(StepInputs(commands=commands))
        for part in waiting:
            part.clear()
        self.simulated_s += time.perf_counter() - began
        self._notify()

    def _ticks_of_running(self) -> NDArray[np.int64]:
        """Return (W,) the ticks of the worlds; -1: the next step begins an episode."""
        arrays = self.worlds.arrays
        begins = arrays.episode_over if self.worlds.in_next_step else np.zeros(1, dtype=np.bool_)
        return np.where(begins, -1, arrays.ticks)

    def forget(self, chosen: NDArray[np.bool_]) -> None:
        """Drop the last actions and the waiting inputs of the chosen worlds (W,)."""
        self.decoder.forget(chosen)
        self.events.forget(chosen)
        self.insertions.forget(chosen)
        self.external.forget(chosen)
        self.overrides.forget(chosen)
        self.lane_changes.forget(chosen)

    def refuse_unready(self, call: str) -> None:
        """Raise an EpisodeError that names a call if there has been no reset yet."""
        if not self.is_ready:
            raise EpisodeError(f"{call} before reset(): call reset(seed=…) first")

    def refuse_idle(self, call: str) -> None:
        """Raise an EpisodeError that names a call before the first reset, or after `close`."""
        self._refuse_closed(call)
        self.refuse_unready(call)

    def _refuse_closed(self, call: str) -> None:
        if self._is_closed:
            raise EpisodeError(f"{call} after close(): make another environment")

    def frames(self, chosen: Sequence[int], ghosts: bool) -> list[WorldFrame]:
        """Return frames of some worlds as they are now; see `WorldsEnvironment.world_frames`."""
        for world in chosen:
            self._check_world(world)
        self.refuse_unready("world_frames()")
        return self._frames(chosen, ghosts)

    def deadlocks(self, world: int) -> tuple[tuple[int, ...], ...]:
        """Return the deadlocks of a world; see `WorldsEnvironment.deadlocks`."""
        self.refuse_unready("deadlocks()")
        self._check_world(world)
        simulation = self.without_sumo()
        return find_deadlocks(
            simulation.network, simulation.travel.steps, simulation.vehicles(world)
        )

    def shown(self) -> Simulation:
        """Return the worlds as they are now; see `WorldsEnvironment.present`."""
        self.refuse_unready("present")
        self._refuse_kept_elsewhere()
        return self.present()

    def _refuse_kept_elsewhere(self) -> None:
        key = kept_elsewhere(self.config)
        if key and not isinstance(unguarded(self.worlds), LocalWorlds):
            raise ConfigError(
                f"{key}: the state of such worlds is only available in the caller's process; use "
                "backend='local'"
            )

    def _check_world(self, world: int) -> None:
        count = len(self.worlds.arrays.mask)
        if not 0 <= world < count:
            raise ConfigError(f"world {world}: must be from 0 to {count - 1}")

    def way_ahead(self, vehicle: int, world: int) -> NDArray[np.float64]:
        """Return the path ahead of a vehicle; see `WorldsEnvironment.way_ahead`."""
        self.refuse_unready("way_ahead()")
        return way_ahead(self._copy.standing(self.worlds), vehicle, world)

    def present(self) -> Simulation:
        """Return the worlds as they are now, or a copy if other processes run them."""
        return self._copy.present(self.worlds)

    def without_sumo(self) -> Simulation:
        """Return the worlds as `present` does, but a copy may lack the routes of SUMO."""
        return self._copy.present(self.worlds, with_sumo=False)

    def picture(
        self, world: int, ghosts_of: int | None, mode: str, name: str, fps: int
    ) -> NDArray[np.uint8] | None:
        """Draw a world as it is now; the first call loads pygame.

        Args:
            world: number of the world.
            ghosts_of: zone whose ghosts are shown; None: show the owners of vehicles.
            mode: `human` for a window, or `rgb_array`. Only the first call reads `mode`, `name` and
                `fps`.
            name: name of the window.
            fps: frames per second of the window.
        """
        self.refuse_unready("render()")
        simulation = self.present()
        if self._view is None:
            self._view = WorldView(simulation, mode, name, fps)
        return self._view.show(ghosts_of, world)

    def watch(self, watcher: Callable[[], None]) -> Callable[[], None]:
        """Call a function after each reset and step; return a function that stops this."""
        self._watchers = (*self._watchers, watcher)

        def end() -> None:
            self._watchers = tuple(one for one in self._watchers if one is not watcher)

        return end

    def record(self, record: Record | None) -> None:
        """Record all worlds from now on; see `WorldsEnvironment.record`."""
        if record is None:
            self._end_recording()
            return
        self._refuse_closed("record()")
        if self._recorder is not None:
            path = str(RecordOptions.of(record).path)
            raise EpisodeError(
                f"record({path!r}): {self._recorder.path} is being recorded; call record(None) "
                "first"
            )
        standing = self._copy.standing(self.worlds)
        # A vector environment begins episodes within steps and loads states; neither is a command.
        state_hash = None if self._in_place else self.worlds.state_hash
        self._recorder = WorldRecorder(record, self.worlds, standing, state_hash)

    def _end_recording(self) -> None:
        if self._recorder is not None:
            recorder, self._recorder = self._recorder, None
            recorder.close()

    def close(self) -> None:
        """End the recording, the window and the worlds; a second call does nothing more."""
        self._is_closed = True
        self._end_recording()
        if self._view is not None:
            self._view.close()
            self._view = None
        self._copy.close()
        self.worlds.close()

    def _frames(
        self,
        chosen: Sequence[int],
        ghosts: bool,
        room: Callable[[int], NDArray[np.void]] | None = None,
    ) -> list[WorldFrame]:
        self._refuse_kept_elsewhere()
        simulation, arrays = self.present(), self.worlds.arrays
        inserted, changed = self.insertions.last, self.lane_changes.last
        return [
            frame_of(
                simulation,
                world,
                ghosts,
                vehicles_that_ended(arrays, world),
                (*inserted(world), *changed(world)),
                room,
            )
            for world in chosen
        ]

    def _notify(self, chosen: NDArray[np.bool_] | None = None) -> None:
        """Record the chosen worlds (W,), or all, as they are now, and call the watchers."""
        if self._recorder is not None:
            every = range(len(self.worlds.arrays.mask))
            some = every if chosen is None else np.flatnonzero(chosen).tolist()
            actions = self.decoder.last if chosen is None else None
            frames = self._frames(some, ghosts=True, room=self._recorder.room)
            self._recorder.add(frames, actions)
        for watcher in self._watchers:
            watcher()

    def __reduce__(self) -> tuple[Any, ...]:
        # Objects that refer to arrays of the worlds are created again.
        parts = self.decoder, self.events, self.insertions, self.external, self.overrides
        memory = (*(part.memory for part in parts), self.lane_changes.memory)
        kept = self.is_ready, self.simulated_s, self._first_seed
        return (
            _restored_session,
            (self.worlds, self._in_place),
            (kept, memory),
        )

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        (self.is_ready, self.simulated_s, self._first_seed), memory = state
        self.decoder.memory, self.events.memory, *memory = memory
        self.insertions.memory, self.external.memory, self.overrides.memory = memory[:3]
        self.lane_changes.memory = memory[3]


def _controlled(config: EnvConfig, worlds: SteppedWorlds) -> SignalAgents | LimitAgents | None:
    """Return the signals or limits that are controlled."""
    if config.signals.are_controlled:
        return SignalAgents(config, worlds.world.network, worlds.arrays)
    if config.limits.are_controlled:
        return LimitAgents(config, worlds.world.network, worlds.arrays)
    return None


def _choices_of_controller(
    controlled: SignalAgents | LimitAgents | None, config: EnvConfig
) -> Callable[[], NDArray[np.int64]] | None:
    """Return a function that returns the choices of the controller; None: agents choose."""
    if config.roadside is not None:
        return None
    if isinstance(controlled, SignalAgents):
        signals, greens = controlled, make_controller(config.signals.controller)
        return lambda: greens.choose(signals.view)
    if isinstance(controlled, LimitAgents):
        units, limits = controlled, make_limit_controller(config.limits.controller)
        return lambda: limits.choose(units.view)
    return None


def _restored_session(worlds: SteppedWorlds, in_place: bool) -> StepSession:
    return StepSession(worlds, in_place=in_place)
