"""Two of CARLA's clients share a world: one client ticks, the other follows or ticks, too.

    python carla_clock_client.py PORT STEPS SHARE WAITS OUTPUT

The program needs CARLA's client and nothing of cavmarl. The second client ticks in SHARE of the
steps, evenly spread. With WAITS = 1, its own tick waits for the next tick of the first client, and
the first client does not wait for the second. OUTPUT is a JSON file. It has the frames that the
first client got from its ticks, the frame that the second client knows after each step, and the
numbers of own and of refused ticks of the second client.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from fractions import Fraction
from pathlib import Path
from queue import Queue
from typing import Any

STEP_S = 0.05
TIMEOUT_S = 20.0


def is_due(step: int, share: Fraction) -> bool:
    """Return whether to tick in a step; of the steps 1 to n, floor(n · share) are due."""
    return int(step * share) > int((step - 1) * share)


def connect(port: int) -> Any:
    import carla  # type: ignore[import-not-found, unused-ignore]

    client = carla.Client("127.0.0.1", port)
    client.set_timeout(TIMEOUT_S)
    return client


class Second(threading.Thread):
    """The second client, which ticks in a share of the steps.

    Attributes:
        steps: a queue with an entry for each tick of the first client; None ends the thread.
        done: number of finished steps.
        own, refused: number of own ticks, and of own ticks with an error.
    """

    def __init__(self, port: int, share: Fraction) -> None:
        super().__init__(daemon=True)
        self._client = connect(port)
        self.world = self._client.get_world()
        self._share = share
        self.steps: Queue[bool | None] = Queue()
        self.done = self.own = self.refused = 0

    def run(self) -> None:
        while self.steps.get() is not None:
            if is_due(self.done + 1, self._share):
                self.own += 1
                try:
                    self.world.tick(TIMEOUT_S)
                except RuntimeError:
                    self.refused += 1
            self.done += 1

    def wait_for(self, frame: int, steps: int) -> None:
        """Wait until this client knows a frame and has finished a number of steps."""
        until_s = time.monotonic() + TIMEOUT_S
        while self.done < steps or self.world.get_snapshot().frame < frame:
            if time.monotonic() > until_s:
                raise TimeoutError(f"the second client does not get to frame {frame}")
            time.sleep(0.0002)


def main() -> None:
    port, steps, share, waits, output = sys.argv[1:]
    client = connect(int(port))
    world = client.get_world()
    settings = world.get_settings()
    settings.synchronous_mode, settings.fixed_delta_seconds = True, STEP_S
    world.apply_settings(settings)
    start = world.tick()
    second = Second(int(port), Fraction(share))
    frames, seen = [start], [start]
    second.wait_for(start, 0)
    second.start()
    for step in range(1, int(steps) + 1):
        frames.append(world.tick())
        second.steps.put(True)
        second.wait_for(frames[-1], 0 if waits == "1" else step)
        seen.append(int(second.world.get_snapshot().frame))
    second.steps.put(None)
    while second.is_alive():
        world.tick()  # ends waiting ticks of the second client
        second.join(0.002)
    settings.synchronous_mode, settings.fixed_delta_seconds = False, None
    world.apply_settings(settings)
    found = {
        "frames": frames,
        "second": seen,
        "own_ticks": second.own,
        "refused": second.refused,
    }
    Path(output).write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main()
