from __future__ import annotations

import numpy as np
import pytest

from cavmarl.sensors.kernels.frame_stacks import newest_frame, repeat_frame, shift_frames


@pytest.mark.parametrize("stack", [1, 2, 4])
def test_frames_move_up_and_the_newest_is_last(stack: int) -> None:
    observation = np.zeros(3 * stack, np.float32)
    frames = [np.full(3, k, np.float32) for k in range(1, 8)]
    for k, frame in enumerate(frames):
        newest = newest_frame(observation, stack)
        shift_frames(observation, stack, 0, 0)
        assert not observation[newest:].any()
        observation[newest:] = frame
        if k == 0:
            repeat_frame(observation, stack)
        past = [frames[max(k - back, 0)] for back in range(stack - 1, -1, -1)]
        np.testing.assert_array_equal(observation, np.concatenate(past))


@pytest.mark.parametrize("stack", [1, 3])
def test_kept_numbers_are_copied_to_the_next_frame(stack: int) -> None:
    observation = np.zeros(4 * stack, np.float32)
    newest = newest_frame(observation, stack)
    observation[newest:] = [1, 2, 3, 4]
    shift_frames(observation, stack, 1, 2)
    assert observation[newest:].tolist() == [0, 2, 3, 0]
    if stack > 1:
        assert observation[newest - 4 : newest].tolist() == [1, 2, 3, 4]
