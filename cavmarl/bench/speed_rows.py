"""The rows of a comparison of speed: what is to be measured, and what was."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

__all__ = ["Row", "Runner"]


@dataclass(frozen=True)
class Row:
    """One way to step one kind of world.

    Attributes:
        sensors: `lidar` (and neighbours), `kinematics` or `puffer_drive`.
        who: `batched`, `single`, `dicts`, `more`, `copied`, `highway_env`, `highway_env_raw`, `c`
            or `c_native`.
        agents: controlled vehicles a world.
        worlds: stepped together.
        low: agent-steps a second, the slowest turn.
        median: over the turns.
        high: the fastest turn.
    """

    sensors: str
    who: str
    agents: int
    worlds: int
    low: float
    median: float
    high: float

    @property
    def agent_step_s(self) -> float:
        """Seconds an agent-step takes, by the median."""
        return 1.0 / self.median


@dataclass(frozen=True)
class Runner:
    """A row to be measured.

    Attributes:
        sensors: of the row.
        who: of the row.
        agents: of the row.
        worlds: of the row.
        rate: steps the worlds and returns agent-steps a second.
    """

    sensors: str
    who: str
    agents: int
    worlds: int
    rate: Callable[[], float]
