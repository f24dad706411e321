from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.errors import ConfigError
from cavmarl.render.animation import AnimationWriter

image = pytest.importorskip("PIL.Image")


def test_an_animation_can_be_read_back(tmp_path: Path) -> None:
    path = tmp_path / "drive.webp"
    with AnimationWriter(path, fps=5.0) as animation:
        for k in range(6):
            animation.write(np.full((48, 96, 3), 40 * k, dtype=np.uint8))
    with image.open(path) as read:
        assert (read.size, read.n_frames, read.info["loop"]) == ((96, 48), 6, 0)
        shades = []
        for k in range(6):
            read.seek(k)
            shades.append(int(np.asarray(read.convert("RGB")).mean()))
            assert read.info["duration"] == 200
    assert shades == pytest.approx(range(0, 240, 40), abs=4)


def test_without_frames_no_file_is_written(tmp_path: Path) -> None:
    with AnimationWriter(tmp_path / "drive.webp", fps=10.0):
        pass
    assert not list(tmp_path.iterdir())


def test_another_format_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"drive\.mp4: the name of an animation must end in"):
        AnimationWriter(tmp_path / "drive.mp4", fps=10.0)


def test_a_missing_folder_is_an_error(tmp_path: Path) -> None:
    animation = AnimationWriter(tmp_path / "none" / "drive.webp", fps=10.0)
    animation.write(np.zeros((48, 96, 3), dtype=np.uint8))
    with pytest.raises(ConfigError, match="cannot write an animation there: No such file"):
        animation.close()
