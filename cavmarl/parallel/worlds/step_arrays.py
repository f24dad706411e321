"""`StepArrays`: the inputs and outputs of a step of W worlds, wherever they run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from cavmarl.balance.balance_plan import Plan
from cavmarl.config.env import EnvConfig
from cavmarl.core.records.external_records import EXTERNAL_FIELDS
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.spaces import flat_observation_space, state_space
from cavmarl.engine.world_setup import World
from cavmarl.parallel.memory.shared_memory import Layout
from cavmarl.sensors.mounted.frames import Frames
from cavmarl.sensors.registry import frame_layout, frames_in
from cavmarl.shards.shard import Commands
from cavmarl.signals.kernels.green_choices import HELD
from cavmarl.signals.kernels.lane_counts import COUNTS
from cavmarl.signals.kernels.lane_history import HISTORY
from cavmarl.signals.sensing import loops_shape
from cavmarl.signals.signal_table import SignalSizes
from cavmarl.v2x.v2x_messages import NetworkSimulator

FINAL_FRAMES = "final_rig."  # prefix of the names of final frames in a layout


class StepArrays(NamedTuple):
    """Arrays of W worlds with A agents each, which every step overwrites.

    T is the number of terms, D the size of a flat observation, and S the number of agents of
    signals or of speed limits (`RoadsideAgents`).
    """

    observations: NDArray[np.float32]  # (W, A, D) for the next action
    final_observations: NDArray[np.float32]  # (W, A, D) last ones of ended agents and episodes
    rewards: NDArray[np.float32]  # (W, A)
    terminations: NDArray[np.bool_]  # (W, A) the agent's vehicle has left the world
    # (W, A) the horizon of the episode, or of the trip (the vehicle then leaves), was reached
    truncations: NDArray[np.bool_]
    acted: NDArray[np.bool_]  # (W, A) agents that acted in the step
    vehicle_done: NDArray[np.bool_]  # (W, A) the trip of the agent's vehicle has ended
    vehicle_ids: NDArray[np.int64]  # (W, A) agent's vehicle at the end of the step; -1: none
    mask: NDArray[np.bool_]  # (W, A) agents that act next
    terms: NDArray[np.float32]  # (W, A, T)
    arrivals: NDArray[np.int64]  # (W,) arrived vehicles since the reset of each world
    ticks: NDArray[np.int64]  # (W,) ticks since the reset of each world
    episode_over: NDArray[np.bool_]  # (W,) worlds that were reset, or will be in the next step
    chosen: NDArray[np.bool_]  # (W,) worlds to reset
    controls: NDArray[np.float64]  # (W, A, 2) see `Commands`, also for the next seven arrays
    meta_actions: NDArray[np.int64]  # (W, A)
    declared: NDArray[np.int32]  # (W, A)
    inserted: NDArray[np.float64]  # (W, I, 3)
    external: NDArray[np.float64]  # (W, E, K)
    overridden: NDArray[np.int32]  # (W, N, 2)
    lane_changes: NDArray[np.float64]  # (W, N, 3)
    # Arrays of agents of signals or of speed limits:
    signal_choices: NDArray[np.int64]  # (W, S)
    signal_observations: NDArray[np.float32]  # (W, S, D) see `SignalOutputs`, also for the next 8
    signal_rewards: NDArray[np.float32]  # (W, S)
    signal_terms: NDArray[np.float32]  # (W, S, T)
    signal_masks: NDArray[np.bool_]  # (W, S, G)
    signal_decides: NDArray[np.bool_]  # (W,)
    signal_counts: NDArray[np.int64]  # (W, N, COUNTS)
    signal_states: NDArray[np.int64]  # (W, S, HELD)
    signal_history: NDArray[np.int64]  # (W, N, HISTORY)
    signal_loops: NDArray[np.int64]  # (W, N, 2, READINGS)
    final_signal_observations: NDArray[np.float32]  # (W, S, D) last ones of ended episodes
    suggested: NDArray[np.float64]  # (W, A, 2) actions of the built-in driver
    states: NDArray[np.float32]  # (W, size) global states at the last request
    frames: Frames  # frames of mounted sensors
    final_frames: Frames  # last frames of an agent or episode that ended

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]]) -> StepArrays:
        """Make step arrays from arrays with the names of `layout_of`."""
        fields: dict[str, Any] = {name: arrays[name] for name in cls._fields if name in arrays}
        return cls(**fields, frames=frames_in(arrays), final_frames=frames_in(arrays, FINAL_FRAMES))

    def part(self, first: int, last: int) -> StepArrays:
        """Return the arrays of the worlds [first, last), as views."""
        *arrays, frames, final_frames = self
        parts: list[Any] = [array[first:last] for array in arrays]
        for rig in (frames, final_frames):
            parts.append({name: sensor.part(first, last) for name, sensor in rig.items()})
        return StepArrays(*parts)


def layout_of(config: EnvConfig, capacity: int, num_worlds: int, signals: SignalSizes) -> Layout:
    """Return name → dtype and shape of `StepArrays`; `capacity`: number of rows of a world."""
    of_signals = (num_worlds, signals.signals)
    observed = ("<f4", (*of_signals, signals.features))
    agents = (num_worlds, config.population.num_ids)
    observations = ("<f4", (*agents, flat_observation_space(config).shape[0]))
    flags = ("|b1", agents)
    return {
        "observations": observations,
        "final_observations": observations,
        "rewards": ("<f4", agents),
        **dict.fromkeys(("terminations", "truncations", "acted", "vehicle_done", "mask"), flags),
        "vehicle_ids": ("<i8", agents),
        "terms": ("<f4", (*agents, len(config.terms.names))),
        "arrivals": ("<i8", (num_worlds,)),
        "ticks": ("<i8", (num_worlds,)),
        "episode_over": ("|b1", (num_worlds,)),
        "chosen": ("|b1", (num_worlds,)),
        "controls": ("<f8", (*agents, 2)),
        "meta_actions": ("<i8", agents),
        "declared": ("<i4", agents),
        "inserted": ("<f8", (num_worlds, config.population.insertions, 3)),
        "external": ("<f8", (num_worlds, config.population.external, EXTERNAL_FIELDS)),
        "overridden": ("<i4", (num_worlds, config.signals.overrides, 2)),
        "lane_changes": ("<f8", (num_worlds, config.map.changed_lanes, 3)),
        "signal_choices": ("<i8", of_signals),
        "signal_observations": observed,
        "final_signal_observations": observed,
        "signal_rewards": ("<f4", of_signals),
        "signal_terms": ("<f4", (*of_signals, signals.terms)),
        "signal_masks": ("|b1", (*of_signals, signals.greens)),
        "signal_decides": ("|b1", (num_worlds,)),
        "signal_counts": ("<i8", (num_worlds, signals.lanes, COUNTS)),
        "signal_states": ("<i8", (*of_signals, HELD)),
        "signal_history": ("<i8", (num_worlds, signals.lanes, HISTORY)),
        "signal_loops": ("<i8", loops_shape(config.signals, num_worlds, signals)),
        "suggested": ("<f8", (*agents, 2)),
        "states": ("<f4", (num_worlds, *state_space(capacity).shape)),
        **frame_layout(config, num_worlds),
        **frame_layout(config, num_worlds, FINAL_FRAMES),
    }


class Driven(NamedTuple):
    """The vehicle of an agent as plain numbers, for drivers outside the process."""

    agent: int  # index
    vehicle_id: int
    vclass: int  # index into `roads.network.VEHICLE_CLASSES`
    length_m: float
    width_m: float
    goal_edge: int  # EDGE row of the goal
    speed_mps: float
    wheelbase_m: float
    # last SPAT received from each signal: SIGNAL row, PHASE row, ticks since it was sent; None: the
    # world has no messages
    heard: list[list[int]] | None = None


class SteppedWorlds(Protocol):
    """W worlds with autoreset, see `CavVectorEnv`."""

    world: World
    arrays: StepArrays  # inputs and outputs of a step
    in_next_step: bool  # a new episode starts one step after the last episode has ended

    @property
    def simulation(self) -> Simulation:
        """The simulation; only available if the worlds run in this process."""
        ...

    @property
    def plans(self) -> tuple[Plan, ...]:
        """One plan of all worlds, or one per world; empty without workers."""
        ...

    @property
    def worker_pids(self) -> Mapping[int, int]:
        """Worker or node → process id, for processes on this machine."""
        ...

    def reset(
        self,
        seed: int | None,  # root of all random numbers; None: continue with the last seed
        first_world: int,  # number of the first world among all worlds with this seed
    ) -> None:
        """Start an episode in the worlds of `chosen`; write `observations` and `mask`."""
        ...

    def step(self, commands: Commands) -> None:
        """Let the agents act, and write all outputs."""
        ...

    def suggest(self) -> None: ...

    def write_states(self) -> None: ...

    def ticks(self) -> NDArray[np.int64]:
        """Return (W,) the ticks since the reset of each world."""
        ...

    def state_hash(self, world: int) -> str: ...

    def traffic_stats(self, world: int) -> dict[str, float]: ...

    def driven(self, world: int, agents: Sequence[int]) -> list[Driven]: ...

    def signal_phases(self, world: int) -> NDArray[np.int32]: ...

    def save_worlds(self) -> list[bytes]:
        """Return the state of each world, for `load_worlds` with any zones and workers."""
        ...

    def load_worlds(self, saved: Sequence[bytes]) -> None:
        """Resume from what `save_worlds` returned; `arrays` do not change."""
        ...

    def connect_network(self, network: NetworkSimulator) -> None:
        """Let a network simulator decide receptions from now on (`v2x.channel.external`)."""
        ...

    def close(self) -> None: ...
