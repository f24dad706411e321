"""`StepTrace` records the order in which the parts of a lock-step cycle act.

Algorithm 1 of the co-simulation paper: SUMO goes to t + Δt, its vehicles are mirrored, the world
ticks exactly once, sensors deliver the frame of t + Δt, the stack computes u, and u is queued for
the next cycle. Each part notes the name of its phase; without a trace this costs
nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

from cavmarl.shards.executor import Executor, PhaseExecutor
from cavmarl.shards.phases import Phase

SUMO = "sumo"  # another simulator has gone to t + Δt
MIRROR = "mirror"  # its vehicles have been moved to where it has them
TICK = "tick"  # the world goes on by one tick
SENSORS = "sensors"  # the frame of t + Δt is made
STACK = "stack"  # controls have come back for it
QUEUE = "queue"  # they wait for the next cycle

# In the order of Algorithm 1.
PHASES = (SUMO, MIRROR, TICK, SENSORS, STACK, QUEUE)

# Phases of the runtime's executor that are phases of a cycle.
# The world is at t + Δt when its rows are committed; those that SUMO moves have moved by then.
_OF_EXECUTOR = {Phase.COMMIT: TICK, Phase.SENSE: SENSORS}


@runtime_checkable
class Traced(Protocol):
    """A part with phases of its own."""

    def trace(self, note: Callable[[str], None]) -> None:
        """From now on call `note` with the name of each phase when it begins."""
        ...


class StepTrace:
    """Notes phases, cycle by cycle."""

    def __init__(self, cycles: int = 10_000) -> None:
        self._cycles: deque[list[str]] = deque(maxlen=cycles)

    @property
    def cycles(self) -> list[tuple[str, ...]]:
        """The phases of each cycle, in the order in which they began."""
        return [tuple(cycle) for cycle in self._cycles]

    def begin(self) -> None:
        self._cycles.append([])

    def note(self, phase: str) -> None:
        """A phase begins; before the first cycle nothing is noted."""
        if self._cycles:
            self._cycles[-1].append(phase)

    def around(self, executor: Executor) -> Executor:
        """Return an executor that notes the phases of another; see `Simulation.trace`."""
        return _Traced(executor, self.note)


class _Traced(PhaseExecutor):
    def __init__(self, executor: Executor, note: Callable[[str], None]) -> None:
        self._executor = executor
        self._note = note

    def run(self, phase: Phase, arguments: tuple[Any, ...]) -> None:
        """Run a phase, and note it if it is one of the cycle's."""
        named = _OF_EXECUTOR.get(phase)
        if named is not None:
            self._note(named)
        phase.run(self._executor, arguments)
