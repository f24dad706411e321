"""A program for worker processes that fail once, in the phase that FAILING_PHASE names."""

from __future__ import annotations

import os
from typing import Any

from cavmarl.parallel.processes.worker_loop import serve
from cavmarl.parallel.workers.job_factory import make_jobs
from cavmarl.parallel.workers.team import TeamMember
from cavmarl.shards.shard_group import ShardGroup

PHASE = os.environ["FAILING_PHASE"]
AT = 9  # the number of the call that fails

run_unchanged = TeamMember.run_phases
phase_unchanged = getattr(ShardGroup, PHASE)
calls = 0


def run_phases(member: TeamMember) -> None:
    """Run the phases, and fail once in one of them."""

    def fail_once(group: ShardGroup, *arguments: Any) -> None:
        global calls
        calls += 1
        if calls == AT:
            raise ZeroDivisionError("of a member")
        phase_unchanged(group, *arguments)

    setattr(ShardGroup, PHASE, fail_once)
    try:
        run_unchanged(member)
    finally:
        setattr(ShardGroup, PHASE, phase_unchanged)


if __name__ == "__main__":
    replaced: Any = TeamMember
    replaced.run_phases = run_phases
    serve(make_jobs)
