"""Executors, which run the phases of a tick on the shards."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.arrays import Demand, DepartureQueue
from cavmarl.shards.phases import Phase
from cavmarl.shards.shard import Commands


class Executor(Protocol):
    """Runs each phase on all shards, and returns when all have run it; see `ShardGroup`."""

    def begin_step(self, commands: Commands) -> None: ...
    def advance(self, commands: Commands) -> None: ...
    def dismiss(self, departures: DepartureQueue) -> None: ...
    def choose_goals(self, demand: Demand, num_goals: int, departures: DepartureQueue) -> None: ...
    def leave(self, departures: DepartureQueue) -> None: ...
    def gather(self, touching_m: float, border_m: float) -> None: ...
    def resolve(self) -> None: ...
    def rank_lanes(self, departures: DepartureQueue) -> None: ...
    def propose(self, demand: Demand, departures: DepartureQueue) -> None: ...
    def admit(self, departures: DepartureQueue) -> None: ...
    def commit(self) -> None: ...
    def detect(self) -> None: ...
    def sense(self, chosen: NDArray[np.bool_]) -> None: ...
    def credit(self, chosen: NDArray[np.bool_]) -> None: ...
    def suggest(self, out: NDArray[np.float64]) -> None: ...
    def retire(self, departures: DepartureQueue) -> None: ...
    def forget(self, departures: DepartureQueue) -> None: ...


class TeamExecutor(Executor, Protocol):
    """Runs phases in several processes. Some phases return before all shards have run them."""

    def finish_phase(self) -> None:
        """Wait until all shards have run the latest phase."""
        ...


class PhaseExecutor(ABC):
    """Base class of executors that treat all phases alike, for example to measure their time."""

    @abstractmethod
    def run(self, phase: Phase, arguments: tuple[Any, ...]) -> None:
        """Run a phase on all shards."""

    def begin_step(self, commands: Commands) -> None:
        self.run(Phase.BEGIN_STEP, (commands,))

    def advance(self, commands: Commands) -> None:
        self.run(Phase.ADVANCE, (commands,))

    def dismiss(self, departures: DepartureQueue) -> None:
        self.run(Phase.DISMISS, (departures,))

    def choose_goals(self, demand: Demand, num_goals: int, departures: DepartureQueue) -> None:
        self.run(Phase.CHOOSE_GOALS, (demand, num_goals, departures))

    def leave(self, departures: DepartureQueue) -> None:
        self.run(Phase.LEAVE, (departures,))

    def gather(self, touching_m: float, border_m: float) -> None:
        self.run(Phase.GATHER, (touching_m, border_m))

    def resolve(self) -> None:
        self.run(Phase.RESOLVE, ())

    def rank_lanes(self, departures: DepartureQueue) -> None:
        self.run(Phase.RANK_LANES, (departures,))

    def propose(self, demand: Demand, departures: DepartureQueue) -> None:
        self.run(Phase.PROPOSE, (demand, departures))

    def admit(self, departures: DepartureQueue) -> None:
        self.run(Phase.ADMIT, (departures,))

    def commit(self) -> None:
        self.run(Phase.COMMIT, ())

    def detect(self) -> None:
        self.run(Phase.DETECT, ())

    def sense(self, chosen: NDArray[np.bool_]) -> None:
        self.run(Phase.SENSE, (chosen,))

    def credit(self, chosen: NDArray[np.bool_]) -> None:
        self.run(Phase.CREDIT, (chosen,))

    def suggest(self, out: NDArray[np.float64]) -> None:
        self.run(Phase.SUGGEST, (out,))

    def retire(self, departures: DepartureQueue) -> None:
        self.run(Phase.RETIRE, (departures,))

    def forget(self, departures: DepartureQueue) -> None:
        self.run(Phase.FORGET, (departures,))
