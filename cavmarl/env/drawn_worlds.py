"""What can be seen of the worlds that an environment steps: pictures, frames, recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium import logger
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.config.terms import TERMS
from cavmarl.core.errors import ConfigError, EpisodeError
from cavmarl.core.records.codes import (
    EVENT_ARRIVED,
    EVENT_COLLIDED,
    EVENT_OFF_ROAD,
    EVENT_RED_LIGHT,
    EVENT_WRONG_WAY,
)
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.vehicle_way import way_ahead
from cavmarl.engine.world_frame import ENDED, NONE_ENDED, WorldFrame, frame_of
from cavmarl.env.insertions import InsertedWorlds
from cavmarl.env.recorded_worlds import Record, WorldRecorder
from cavmarl.parallel.backends import shows_state
from cavmarl.parallel.journaled_worlds import unwatched
from cavmarl.parallel.local_worlds import LocalWorlds, kept_elsewhere
from cavmarl.parallel.nodes.node_worlds import NodeWorlds
from cavmarl.parallel.step_arrays import SteppedWorlds
from cavmarl.recordings.extra_tables import RecordOptions
from cavmarl.render.topdown import WorldView

RENDER_MODES = ("human", "rgb_array")

# The terms that say how an agent's vehicle ended.
_ENDS = {
    TERMS.index("collision"): EVENT_COLLIDED,
    TERMS.index("off_road"): EVENT_OFF_ROAD,
    TERMS.index("wrong_way"): EVENT_WRONG_WAY,
    TERMS.index("red_light"): EVENT_RED_LIGHT,
    TERMS.index("arrival"): EVENT_ARRIVED,
}


def check_rendering(
    config: EnvConfig,
    render_mode: str | None,
    num_worlds: int,
    workers: int | str | None,
    hosts: str | None,
    modes: tuple[str, ...] = RENDER_MODES,
) -> None:
    """Refuse what cannot be drawn.

    Raises:
        ConfigError: a mode that is not one of `modes`, or worlds whose state cannot be had here.
    """
    if render_mode is None:
        return
    if render_mode not in modes:
        raise ConfigError(f"render_mode = {render_mode!r}: must be {' or '.join(modes)}, or None")
    with_sumo = config.traffic.source != "native"
    is_here = not workers and hosts in (None, "local")
    if not is_here and (with_sumo or not shows_state(num_worlds, workers, hosts)):
        what = f" and traffic.source = {config.traffic.source!r}" if with_sumo else ""
        raise ConfigError(
            f"render_mode = {render_mode!r} with workers = {workers or hosts!r}{what}: such worlds "
            "are only drawn in the caller's process; use workers=0"
        )


class DrawnWorlds(InsertedWorlds):
    """Base of an environment whose worlds can be seen; pygame is loaded at the first picture.

    Attributes:
        worlds: that it steps.
        metadata: with `name` and `render_fps`.
        render_mode: `human`, `rgb_array` or None.
    """

    worlds: SteppedWorlds
    metadata: dict[str, Any]
    render_mode: str | None
    _ready: bool = False  # whether `reset` has been called
    _view: WorldView | None
    _copied: LocalWorlds | None = None  # of worlds that other processes have
    _writer: WorldRecorder | None = None
    _watchers: tuple[Callable[[], None], ...] = ()

    def _frame(self, world: int = 0, ghosts_of: int | None = None) -> NDArray[np.uint8] | None:
        """A world as it is now; None and a warning without a render_mode, as Gymnasium has it."""
        if self.render_mode is None:
            logger.warn(
                "render() without a render_mode shows nothing: make the environment with "
                "render_mode='rgb_array'"
            )
            return None
        if not self._ready:
            raise EpisodeError("render() before reset(): call reset(seed=…) first")
        simulation = self._shown()
        if self._view is None:
            name, fps = self.metadata["name"], self.metadata["render_fps"]
            self._view = WorldView(simulation, self.render_mode, name, fps)
        return self._view.show(ghosts_of, world)

    def world_frames(self, chosen: Sequence[int] = (0,), ghosts: bool = False) -> list[WorldFrame]:
        """What is to be seen of some worlds now, as data; see `engine.world_frame.WorldFrame`.

        Where worlds live in other processes, all of them are copied from there.

        Args:
            chosen: numbers of worlds.
            ghosts: whether to tell what each zone sees of the others' vehicles.

        Raises:
            ConfigError: no such world, or one whose state cannot be had here.
            EpisodeError: before the first reset.
        """
        return self._frames_of(chosen, ghosts)

    def _frames_of(
        self,
        chosen: Sequence[int],
        ghosts: bool,
        room: Callable[[int], NDArray[np.void]] | None = None,
    ) -> list[WorldFrame]:
        worlds = self.worlds
        count = len(worlds.arrays.mask)
        if wrong := [world for world in chosen if not 0 <= world < count]:
            raise ConfigError(f"world {wrong[0]}: there are the worlds 0 to {count - 1}")
        if not self._ready:
            raise EpisodeError("world_frames() before reset(): call reset(seed=…) first")
        key = kept_elsewhere(worlds.world.config)
        if key and not isinstance(worlds, LocalWorlds):
            raise ConfigError(
                f"{key}: frames of such worlds can only be had in the caller's process; use "
                "workers=0"
            )
        simulation, told = self._shown(), self._insertions.told
        return [
            frame_of(simulation, world, ghosts, self._ended(world), told(world), room)
            for world in chosen
        ]

    @property
    def is_ready(self) -> bool:
        """Whether there is a present moment: `reset` has been called."""
        return self._ready

    def way_ahead(self, vehicle: int, world: int = 0) -> NDArray[np.float64]:
        """Points (n, 2) in m of the way of a vehicle, as of the last `world_frames`.

        Raises:
            EpisodeError: before the first reset.
        """
        if not self._ready:
            raise EpisodeError("way_ahead() before reset(): call reset(seed=…) first")
        return way_ahead(self._standing(), vehicle, world)

    def watch(self, look: Callable[[], None]) -> Callable[[], None]:
        """Have a function called after each reset and step; returns what ends that."""
        self._watchers = (*self._watchers, look)

        def end() -> None:
            self._watchers = tuple(one for one in self._watchers if one is not look)

        return end

    def _ended(self, world: int) -> NDArray[np.void]:
        """ENDED of the last step."""
        arrays = self.worlds.arrays
        if not arrays.vehicle_done[world].any():
            return NONE_ENDED
        agents = np.flatnonzero(arrays.vehicle_done[world])
        ended = np.zeros(len(agents), dtype=ENDED)
        ended["agent"] = agents
        for term, bit in _ENDS.items():
            ended["events"][arrays.terms[world, agents, term] > 0.0] |= bit
        return ended

    def record(self, record: Record | None) -> None:
        """Record all worlds from the next reset or step on, until `close`; see docs/recordings.md.

        Args:
            record: a new folder, or that and what else is recorded; None: record nothing.

        Raises:
            ConfigError: something else is wanted that there is not.
            EpisodeError: a recording has begun already.
            RecordingError: there is something at `path`, or it cannot be written.
            MissingExtraError: pyarrow is not installed.
        """
        if record is None:
            return
        if self._writer is not None:
            path = str(RecordOptions.of(record).path)
            raise EpisodeError(f"record({path!r}): {self._writer.path} is recorded already")
        self._writer = WorldRecorder(record, self.worlds, self._standing())

    def _record_frames(self, chosen: NDArray[np.bool_] | None = None) -> None:
        """Show the present moment of the chosen worlds (W,), or of all, and record it."""
        if self._writer is not None:
            every = range(len(self.worlds.arrays.mask))
            some = every if chosen is None else np.flatnonzero(chosen).tolist()
            self._writer.add(self._frames_of(some, ghosts=True, room=self._writer.room))
        for look in self._watchers:
            look()

    def _standing(self) -> Simulation:
        """The worlds, or a copy of them as they have been at some time."""
        worlds = self.worlds
        if isinstance(worlds, LocalWorlds):
            return worlds.simulation
        if self._copied is None:
            self._copied = LocalWorlds(unwatched(worlds.world), len(worlds.arrays.mask))
        return self._copied.simulation

    def _shown(self) -> Simulation:
        """The worlds, or a copy of them as they are now where they live in other processes."""
        simulation = self._standing()
        if self._copied is not None:
            if isinstance(self.worlds, NodeWorlds):
                simulation.divide(self.worlds.partition)
            self._copied.load_worlds(self.worlds.save_worlds())
        return simulation

    def _close_view(self) -> None:
        """Close the window and the recording, if there are any."""
        if self._writer is not None:
            writer, self._writer = self._writer, None
            writer.close()
        if self._view is not None:
            self._view.close()
            self._view = None
        if self._copied is not None:
            self._copied.close()
            self._copied = None
