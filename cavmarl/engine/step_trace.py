"""`StepTrace` records the order of the phases in a lock-step cycle of a co-simulation.

The phases follow Algorithm 1 of the co-simulation paper (docs/explanation/papers.md): SUMO steps to
t + Δt, its vehicles are mirrored, the world ticks exactly once, sensors deliver the frame of
t + Δt, the external driving stack computes the controls u, and u is queued for the next cycle.
Each part notes the name of its phase.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

from cavmarl.shards.executor import Executor, PhaseExecutor
from cavmarl.shards.phases import Phase

SUMO = "sumo"  # the other simulator steps to t + Δt
MIRROR = "mirror"  # its vehicles are moved to their new positions
TICK = "tick"  # the world advances by one tick
SENSORS = "sensors"  # sensors make the frame of t + Δt
STACK = "stack"  # the stack returns the controls for this frame
QUEUE = "queue"  # the controls are queued for the next cycle

# The phases in the order of Algorithm 1.
PHASES = (SUMO, MIRROR, TICK, SENSORS, STACK, QUEUE)

# Phases of the executor that are phases of a cycle. A commit brings the world to t + Δt, after the
# vehicles of SUMO have moved.
_OF_EXECUTOR = {Phase.COMMIT: TICK, Phase.SENSE: SENSORS}


@runtime_checkable
class Traced(Protocol):
    """A part with phases of its own."""

    def trace(self, note: Callable[[str], None]) -> None:
        """Call `note` with the name of each phase when it begins, from now on."""
        ...


class StepTrace:
    """A record of the phases of the last cycles."""

    def __init__(self, cycles: int = 10_000) -> None:
        self._cycles: deque[list[str]] = deque(maxlen=cycles)

    @property
    def cycles(self) -> list[tuple[str, ...]]:
        """The phases of each cycle, in the order in which they began."""
        return [tuple(cycle) for cycle in self._cycles]

    def begin(self) -> None:
        self._cycles.append([])

    def note(self, phase: str) -> None:
        """Record that a phase begins. Phases before the first cycle are ignored."""
        if self._cycles:
            self._cycles[-1].append(phase)

    def around(self, executor: Executor) -> Executor:
        """Return an executor that runs and records phases; see `Simulation.trace`."""
        return _Traced(executor, self.note)


class _Traced(PhaseExecutor):
    def __init__(self, executor: Executor, note: Callable[[str], None]) -> None:
        self._executor = executor
        self._note = note

    def run(self, phase: Phase, arguments: tuple[Any, ...]) -> None:
        """Run a phase, and record it if it belongs to a cycle."""
        named = _OF_EXECUTOR.get(phase)
        if named is not None:
            self._note(named)
        phase.run(self._executor, arguments)
