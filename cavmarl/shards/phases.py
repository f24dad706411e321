"""The phases of a tick that shards run, and how several processes may run each phase.

A new phase needs

- a kernel in `shards/kernels/group_phases.py`, a method of `ShardGroup` and a member of `Phase`;
- a method of `Executor` and of `PhaseExecutor` in `shards/executor.py`;
- its place in the order: `engine/tick.py`, and again in `engine/compiled_step.py`;
- its arguments in `parallel/workers/team_job.py`, if workers share it (`is_shared`);
- a row in the table "One tick" of `docs/explanation/architecture.md`.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import Any, NamedTuple

from cavmarl.shards.shard_group import ShardGroup


class PhaseRule(NamedTuple):
    """The ways in which a phase may be run."""

    method: Callable[..., None]  # method of `ShardGroup` that calls the kernel of the phase
    is_shared: bool = False  # whether workers share its zones; if not, one process runs all zones
    is_late: bool = False  # whether the next phase needs its results in the same zone only
    is_early: bool = False  # whether it needs results of the previous phase in its own zone only
    is_beside: bool = False  # whether the phase runs outside of a tick, and adds no cost to a zone


class Phase(Enum):
    """The phases in the order of a tick; `engine/tick.py` runs them."""

    BEGIN_STEP = PhaseRule(ShardGroup.begin_step, is_shared=True, is_late=True)
    ADVANCE = PhaseRule(ShardGroup.advance)
    MOVE = PhaseRule(ShardGroup.move, is_shared=True)
    DISMISS = PhaseRule(ShardGroup.dismiss)
    CHOOSE_GOALS = PhaseRule(ShardGroup.choose_goals)
    LEAVE = PhaseRule(ShardGroup.leave)
    GATHER = PhaseRule(ShardGroup.gather, is_shared=True)
    RESOLVE = PhaseRule(ShardGroup.resolve, is_shared=True, is_late=True)
    RANK_LANES = PhaseRule(ShardGroup.rank_lanes)
    PROPOSE = PhaseRule(ShardGroup.propose)
    ADMIT = PhaseRule(ShardGroup.admit)
    COMMIT = PhaseRule(ShardGroup.commit, is_early=True)
    DETECT = PhaseRule(ShardGroup.detect, is_early=True)
    SENSE = PhaseRule(ShardGroup.sense, is_shared=True)
    CREDIT = PhaseRule(ShardGroup.credit, is_shared=True)
    SUGGEST = PhaseRule(ShardGroup.suggest, is_shared=True, is_beside=True)
    RETIRE = PhaseRule(ShardGroup.retire)
    FORGET = PhaseRule(ShardGroup.forget)

    def run(self, executor: Any, arguments: tuple[Any, ...]) -> None:
        """Call the executor's method of this phase."""
        getattr(executor, self.value.method.__name__)(*arguments)
