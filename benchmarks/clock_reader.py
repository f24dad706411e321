"""A program that follows a world's clock, records it, and on request ticks by itself.

    python -m benchmarks.clock_reader ADDRESS SHARE

At the end it prints one line of JSON: the world's tick when it joined, then after each step, as the
follower has it then, what the clock of its own process says meanwhile (seconds since it joined),
and how many of its own ticks were refused. It ticks by itself in SHARE of the steps, spread as
evenly as can be.
"""

from __future__ import annotations

import json
import sys
import time
from fractions import Fraction

from cavmarl.core.errors import ClockError
from cavmarl.cosim.followers.follower_client import Follower


def is_due(step: int, share: Fraction) -> bool:
    """Whether step 1, 2, … is one of those: of the first n there are always floor(n · share)."""
    return int(step * share) > int((step - 1) * share)


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
