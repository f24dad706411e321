"""Access to internal parts of a running world for tests."""

from __future__ import annotations

from typing import Any

from cavmarl.engine.simulation import Simulation
from cavmarl.engine.tick import Tick
from cavmarl.shards.executor import Executor, PhaseExecutor
from cavmarl.shards.phases import Phase
from cavmarl.traffic.native import NativeTraffic


class PhaseLog(PhaseExecutor):
    """An executor that passes phases on to another executor and stores their order."""

    def __init__(self, executor: Executor) -> None:
        self.phases: list[Phase] = []
        self._executor = executor

    def run(self, phase: Phase, arguments: tuple[Any, ...]) -> None:
        self.phases.append(phase)
        phase.run(self._executor, arguments)


def tick_of(simulation: Simulation) -> Tick:
    """Return the tick of a simulation, whose phases a test can run one by one."""
    return simulation._tick


def traffic_of(simulation: Simulation) -> NativeTraffic:
    """Return the generator of departures and the demand."""
    return simulation._tick.traffic


def coordination_of(simulation: Simulation) -> Any:
    """Return the part of the tick that coordinates ownership."""
    return simulation._tick.coordination


def executor_of(simulation: Simulation) -> Executor:
    """Return the executor of the phases of the shards."""
    return simulation._tick.executor


def use_executor(simulation: Simulation, executor: Executor) -> None:
    """Let another executor run the phases of the shards."""
    simulation._tick.executor = executor


def log_phases(simulation: Simulation) -> PhaseLog:
    """Let the world run phase by phase, and return a log of its phases."""
    log = PhaseLog(executor_of(simulation))
    use_executor(simulation, log)
    return log


def is_compiled(simulation: Simulation) -> bool:
    """Return whether the last step was one compiled call."""
    return simulation._compiled_step is not None
