"""Save worlds in the middle of a run, and resume them with other zones."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from typing import Any

from cavmarl import make_vec


def check_resumed(
    act: Callable[[Any, int], None],  # called before each step with the environment and the step
    overrides: dict[str, Any],
    at: int,  # the state is saved before this step
    steps: int,
) -> None:
    """Check that resumed runs, with one and with two zones, end in the state of the whole run."""

    def finished(first: int, saved: bytes | None, zones: int) -> tuple[str, bytes]:
        with closing(
            make_vec("grid4x4", agents=3, background=20, overrides=overrides, zones=zones)
        ) as vec:
            vec.reset(seed=1)
            if saved is not None:
                vec.load_state(saved)
            kept = b""
            for step in range(first, steps):
                if saved is None or step > first:
                    act(vec, step)
                if step == at:
                    kept = vec.save_state()
                vec.step(vec.suggest_actions())
            return vec.state_hash(0), kept

    wanted, saved = finished(0, None, 1)
    assert finished(at, saved, 1)[0] == wanted
    assert finished(at, saved, 2)[0] == wanted
