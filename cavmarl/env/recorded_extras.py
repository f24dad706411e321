"""Optional tables of a recording: observations, sensor samples, messages, commands."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import ConfigError
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_frame import WorldFrame
from cavmarl.env.recorded_inputs import INPUTS, StepInputs, inputs_dtype, inputs_row
from cavmarl.ownership.messages import COORDINATOR, Ack, Message, Nack, Record, Step
from cavmarl.ownership.trace import LOG, TraceEntry, describe
from cavmarl.parallel.worlds.step_arrays import StepArrays
from cavmarl.sensors.observed import feature_names
from cavmarl.v2x.kernels.v2x_records import REPORT

SAMPLES = "samples-"  # prefix of the name of a sensor's table
V2X, HANDOVERS = "v2x", "handovers"
_WHOSE = [("tick", "<i8"), ("agent", "<i4"), ("vehicle", "<i8")]
# One report of a packet; `tick`, `sender`, `kind`, `from_x` and `from_y` (m) belong to the packet.
_V2X = np.dtype(
    [
        ("tick", "<i8"),
        ("from_x", "<f8"),
        ("from_y", "<f8"),
        *((name, REPORT[name].str) for name in REPORT.names or () if name != "tick"),
        ("of_tick", "<i8"),  # tick that the report describes
    ]
)
# `sender` and `receiver` are zones; -1: the coordinator, -2: its log.
_HANDOVERS = np.dtype(
    [("tick", "<i8"), ("sender", "<i4"), ("receiver", "<i4"), ("kind", "O"), ("text", "O")]
)

Rows = NDArray[np.void]


def check_extras(config: EnvConfig, include: Iterable[str], is_here: bool) -> None:
    """Raise an error if a requested table cannot be recorded.

    Raises:
        ConfigError: the worlds have no such data, or it is not available in this process.
    """
    sensed = config.observation.mode == "sensors" and config.observation.kind == "dict"
    reasons = {
        "observations": sensed and "observations are sensor samples here: include samples",
        "samples": not config.rig and "no vehicle carries sensors: set rig",
        "messages": (
            not (config.v2x.enabled or config.zones.count > 1)
            and "no messages are sent: set v2x.enabled, or zones.count above 1"
        )
        or (
            not is_here
            and "messages are only available in the caller's process: use backend='local'"
        ),
    }
    for name in include:
        if reasons.get(name):
            raise ConfigError(f"record: include {name!r}: {reasons[name]}")


class RecordedExtras:
    """Gathers the rows of the optional tables, world by world.

    Args:
        config: configuration of the worlds.
        include: any of `observations`, `samples`, `messages` and `commands`.
        arrays: results of the worlds' steps.
        simulation: the worlds; their messages are logged from now on.
        state_hash: returns the hash of a world; None: `commands` are not available.

    Attributes:
        dtypes: dtypes of the tables, by table name.
        features: sensor and name of each number of the newest frame of an observation.
        inputs: inputs of the last reset or step.
    """

    def __init__(
        self,
        config: EnvConfig,
        include: Iterable[str],
        arrays: StepArrays,
        simulation: Simulation,
        state_hash: Callable[[int], str] | None = None,
    ) -> None:
        self._arrays = arrays
        self._ticks = np.full(len(arrays.mask), -1, dtype=np.int64)  # last frame
        self._step_ticks = config.clock.ticks_per_step
        self._state_hash = state_hash
        self.inputs = StepInputs()
        wanted = frozenset(include)
        self.dtypes: dict[str, np.dtype[Any]] = {}
        self.features: list[tuple[str, str]] = []
        if "observations" in wanted:
            numbers, terms = arrays.observations.shape[2], arrays.terms.shape[2]
            is_pair = config.action.kind == "continuous"
            self.dtypes["observations"] = np.dtype(
                [
                    *_WHOSE,
                    ("acted", "|b1"),
                    ("action", "<f4", (2,)) if is_pair else ("action", "<i8"),
                    ("reward", "<f4"),
                    ("terminated", "|b1"),
                    ("truncated", "|b1"),
                    ("terms", "<f4", (terms,)),
                    ("values", "<f4", (numbers,)),
                ]
            )
            if config.observation.mode != "sensors":
                self.features = feature_names(config.sensors)
        if "samples" in wanted:
            for name, frames in arrays.frames.items():
                data = ("data", frames.data.dtype.str, frames.data.shape[3:])
                own = np.dtype([*_WHOSE, ("stamp_s", "<f8"), ("lost", "|b1"), data])
                self.dtypes[SAMPLES + name] = own
        if INPUTS in wanted:
            if state_hash is None or len(arrays.mask) > 1:
                raise ConfigError(
                    f"record: include {INPUTS!r}: only the commands of one world of `parallel_env` "
                    "can be recorded; leave it out"
                )
            self.dtypes[INPUTS] = inputs_dtype(config, arrays)
        self._logs: dict[str, _SentLog] = {}
        if "messages" in wanted:
            self._listen(config, simulation)

    def _listen(self, config: EnvConfig, simulation: Simulation) -> None:
        if config.v2x.enabled:
            self.dtypes[V2X], log = _V2X, _SentLog(_V2X)
            self._logs[V2X] = log
            simulation.messages.watch(partial(_note_sent, log))
        if simulation.coordinators:
            self.dtypes[HANDOVERS], log = _HANDOVERS, _SentLog(_HANDOVERS)
            self._logs[HANDOVERS] = log
            for world, coordinator in enumerate(simulation.coordinators):
                coordinator.watch(_HandoverWatch(log, world))

    def of(self, frame: WorldFrame, actions: NDArray[Any] | None) -> Mapping[str, Rows]:
        """Return the new rows of a world since the last call, by table.

        Args:
            frame: the frame that the rows belong to.
            actions: (W, A, …) of the step that led to the frame; None: the episode was reset.
        """
        if not self.dtypes:
            return {}
        world, tick = frame.world, frame.tick
        found = {name: log.take(world) for name, log in self._logs.items()}
        agents = np.flatnonzero(self._arrays.vehicle_ids[world] >= 0)
        for name, dtype in self.dtypes.items():
            if name == "observations":
                found[name] = self._observed(dtype, frame, actions)
            elif name == INPUTS and self._state_hash is not None:
                found[name] = inputs_row(dtype, self.inputs, tick, self._state_hash(world))
            elif name.startswith(SAMPLES):
                found[name] = self._samples(name, dtype, world, tick, agents)
        self._ticks[world] = tick
        return found

    def at_the_end(self, world: int, actions: NDArray[Any]) -> Mapping[str, Rows]:
        """Return the rows of the last step of an episode, whose last frame is not available.

        For the arguments, see `of`.
        """
        dtype = self.dtypes.get("observations")
        return {} if dtype is None else {"observations": self._results(dtype, world, None, actions)}

    def _observed(
        self, dtype: np.dtype[Any], frame: WorldFrame, actions: NDArray[Any] | None
    ) -> Rows:
        """Return rows of the agents that acted in the step, or that act next, by tick and agent.

        If the step has also reset the world, its results belong to the previous episode.
        """
        arrays, world, tick = self._arrays, frame.world, frame.tick
        is_new = actions is None or tick <= self._ticks[world]
        begins = arrays.mask[world].copy()
        parts = []
        if actions is not None:
            parts.append(self._results(dtype, world, None if is_new else tick, actions))
            begins &= is_new | ~arrays.acted[world]
        agents = np.flatnonzero(begins)
        rows = self._whose(dtype, world, tick, agents)
        driven = frame.vehicles[frame.vehicles["agent"] >= 0]
        order = np.argsort(driven["agent"])
        place = np.searchsorted(driven["agent"], agents, sorter=order)
        rows["vehicle"] = driven["id"][order[place]]
        if not is_new or actions is None:
            rows["terms"] = arrays.terms[world, agents]
        rows["values"] = arrays.observations[world, agents]
        parts.append(rows)
        found = np.concatenate(parts)
        return found[np.lexsort((found["agent"], found["tick"]))]

    def _results(
        self, dtype: np.dtype[Any], world: int, tick: int | None, actions: NDArray[Any]
    ) -> Rows:
        """Return a row of each agent that acted in the last step; `tick` None: the next tick.

        If a trip or the episode has ended, the row has the last observation before the end.
        """
        arrays = self._arrays
        agents = np.flatnonzero(arrays.acted[world])
        if tick is None:
            tick = int(self._ticks[world]) + self._step_ticks
        rows = self._whose(dtype, world, tick, agents)
        has_ended = arrays.episode_over[world] or arrays.terminations[world].any()
        seen = arrays.final_observations if has_ended else arrays.observations
        taken = actions[world, agents]
        rows["acted"] = True
        rows["action"] = taken if taken.dtype.kind == "i" else taken.clip(-1.0, 1.0)
        rows["reward"] = arrays.rewards[world, agents]
        rows["terminated"] = arrays.terminations[world, agents]
        rows["truncated"] = arrays.truncations[world, agents]
        rows["terms"] = arrays.terms[world, agents]
        rows["values"] = seen[world, agents]
        return rows

    def _whose(self, dtype: np.dtype[Any], world: int, tick: int, agents: NDArray[np.intp]) -> Rows:
        rows = np.zeros(len(agents), dtype)
        rows["tick"], rows["agent"] = tick, agents
        rows["vehicle"] = self._arrays.vehicle_ids[world, agents]
        return rows

    def _samples(
        self, name: str, dtype: np.dtype[Any], world: int, tick: int, agents: NDArray[np.intp]
    ) -> Rows:
        """Return the samples of one sensor in the last step."""
        frames = self._arrays.frames[name.removeprefix(SAMPLES)]
        slots = frames.stamp_s.shape[2]
        fresh = np.arange(slots) >= slots - frames.fresh[world, agents, None]
        place, slot = np.nonzero(fresh)
        rows = self._whose(dtype, world, tick, agents[place])
        for column, array in (("data", frames.data), ("stamp_s", frames.stamp_s)):
            rows[column] = array[world, agents[place], slot]
        rows["lost"] = frames.lost[world, agents[place], slot]
        return rows


class _SentLog:
    """A log of rows by world and tick, emptied by `take`; a repeated tick is logged once."""

    def __init__(self, dtype: np.dtype[Any]) -> None:
        self._dtype = dtype
        self._rows: dict[int, list[tuple[int, Rows]]] = {}

    def note(self, world: int, tick: int, rows: Rows) -> None:
        self._rows.setdefault(world, []).append((tick, rows))

    def forget_from(self, world: int, tick: int) -> None:
        """Drop the rows of a tick that is run again."""
        kept = self._rows.get(world, [])
        while kept and kept[-1][0] == tick:
            kept.pop()

    def take(self, world: int) -> Rows:
        rows = [rows for _, rows in self._rows.pop(world, [])]
        return np.concatenate([np.zeros(0, self._dtype), *rows])


def _note_sent(log: _SentLog, world: int, tick: int, packets: Rows, reports: Rows) -> None:
    """Log the packets of a tick, one row per report."""
    counts = packets["count"]
    packet = np.repeat(np.arange(len(packets)), counts)
    within = np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)
    row_reports = reports[packets["first"][packet] + within]
    rows = np.zeros(len(row_reports), _V2X)
    for name in REPORT.names or ():
        rows["of_tick" if name == "tick" else name] = row_reports[name]
    rows["tick"], rows["kind"] = tick, packets["kind"][packet]
    rows["from_x"], rows["from_y"] = packets["x"][packet], packets["y"][packet]
    rows["sender"] = packets["sender"][packet]
    log.forget_from(world, tick)
    log.note(world, tick, rows)


class _HandoverWatch:
    """Logs the messages between a coordinator and its zones; a `coordinator.Watcher`."""

    def __init__(self, log: _SentLog, world: int) -> None:
        self._log = log
        self._world = world

    def logged(self, records: Iterable[Record]) -> None:
        for record in records:
            self._note(TraceEntry(LOG, record), COORDINATOR)

    def delivered(self, destination: int, message: Message) -> None:
        self._note(TraceEntry(destination, message), _sender_of(message))

    def _note(self, entry: TraceEntry, sender: int) -> None:
        item = entry.item
        row = np.zeros(1, _HANDOVERS)
        row[0] = item.tick, sender, entry.destination, type(item).__name__.upper(), describe(entry)
        self._log.note(self._world, item.tick, row)


def _sender_of(message: Message) -> int:
    if isinstance(message, Step):
        return COORDINATOR
    if isinstance(message, Ack | Nack):
        return message.zone
    return int(getattr(message, "source", getattr(message, "zone", COORDINATOR)))
