"""Workers of which a follower fails once, in a phase of its own; run as a program."""

from __future__ import annotations

from typing import Any

from cavmarl.parallel.job_factory import make_jobs
from cavmarl.parallel.processes.worker_loop import serve
from cavmarl.parallel.team.team import TeamFollower
from cavmarl.shards.shard_group import ShardGroup

AT = 9  # the call of it that fails

follows = TeamFollower.follow
resolves = ShardGroup.resolve
calls = 0


def follow(follower: TeamFollower) -> None:
    """As it is, but what it runs fails once."""

    def resolve(group: ShardGroup) -> None:
        global calls
        calls += 1
        if calls == AT:
            raise ZeroDivisionError("a follower's own")
        resolves(group)

    put: Any = ShardGroup
    put.resolve = resolve
    try:
        follows(follower)
    finally:
        put.resolve = resolves


if __name__ == "__main__":
    replaced: Any = TeamFollower
    replaced.follow = follow
    serve(make_jobs)
