"""A program that follows a world's clock, records it, and optionally ticks on its own.

    python -m benchmarks.clock_reader ADDRESS SHARE

The follower ticks on its own in SHARE of the steps, evenly spread. At the end, it prints one line
of JSON: the world's tick that it knew when it joined and after each step, its own process clock in
seconds since it joined, and the numbers of its own ticks and of those that were refused.
"""

from __future__ import annotations

import json
import sys
import time
from fractions import Fraction

from benchmarks.carla_clock_client import is_due
from cavmarl.core.errors import ClockError
from cavmarl.cosim.followers.follower_client import Follower


def _main(place: str, share: Fraction) -> None:
    ticks: list[int] = []
    own_s: list[float] = []
    own = refused = 0
    with Follower(int(place) if place.isdecimal() else place, name="clock reader") as follower:
        for sight in follower:
            tick = sight.snapshot.tick
            if ticks and is_due(len(ticks), share):
                own += 1
                try:
                    tick = follower.tick().tick
                except ClockError:
                    refused += 1
            ticks.append(tick)
            own_s.append(time.monotonic())
            if not sight.snapshot.is_over:
                follower.answer({})
    since_s = [now_s - own_s[0] for now_s in own_s]
    print(json.dumps({"ticks": ticks, "own_s": since_s, "own_ticks": own, "refused": refused}))


if __name__ == "__main__":
    _main(sys.argv[1], Fraction(sys.argv[2]))
