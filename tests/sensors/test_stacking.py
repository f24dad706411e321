from __future__ import annotations

import numpy as np
import pytest

from cavmarl.sensors.kernels.output_reset import newest_frame, repeat_frame, shift_frames


@pytest.mark.parametrize("stack", [1, 2, 4])
def test_frames_move_up_and_the_newest_is_last(stack: int) -> None:
    observation = np.zeros(3 * stack, np.float32)
    frames = [np.full(3, k, np.float32) for k in range(1, 8)]
    for k, frame in enumerate(frames):
        newest = newest_frame(observation, stack)
        shift_frames(observation, stack)
        assert not observation[newest:].any()
        observation[newest:] = frame
        if k == 0:
            repeat_frame(observation, stack)
        past = [frames[max(k - back, 0)] for back in range(stack - 1, -1, -1)]
        np.testing.assert_array_equal(observation, np.concatenate(past))
