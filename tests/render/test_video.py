from __future__ import annotations

import contextlib
import importlib
from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.errors import ConfigError, MissingExtraError
from cavmarl.render.video import VideoWriter

imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")

# The reader of imageio-ffmpeg does not close its pipes.
reads_back = pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")


def read(path: Path) -> tuple[dict[str, object], list[np.ndarray]]:
    frames = imageio_ffmpeg.read_frames(str(path))
    meta = next(frames)
    width, height = meta["size"]
    return meta, [np.frombuffer(f, np.uint8).reshape(height, width, 3) for f in frames]


@reads_back
@pytest.mark.parametrize(("height", "width"), [(64, 96), (65, 97)])
def test_video_can_be_read_back(tmp_path: Path, height: int, width: int) -> None:
    path = tmp_path / "new" / "drive.mp4"
    with VideoWriter(path, fps=10.0) as video:
        for k in range(12):
            video.write(np.full((height, width, 3), 20 * k, dtype=np.uint8))
    meta, frames = read(path)
    assert video.num_frames == len(frames) == 12
    assert meta["codec"] == "h264"
    assert str(meta["pix_fmt"]).startswith("yuv420p")
    assert meta["fps"] == 10.0
    assert frames[0].shape == (height + height % 2, width + width % 2, 3)
    assert [int(frame.mean()) for frame in frames] == pytest.approx(range(0, 240, 20), abs=4)


@reads_back
def test_the_video_is_complete_after_an_exception_in_the_with_block(tmp_path: Path) -> None:
    path = tmp_path / "drive.mp4"
    with contextlib.suppress(KeyError), VideoWriter(path, fps=10.0) as video:
        video.write(np.zeros((64, 64, 3), dtype=np.uint8))
        raise KeyError
    assert len(read(path)[1]) == 1


def test_without_frames_no_file_is_written(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "drive.mp4", fps=10.0):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["file/drive.mp4", "folder.mp4", "drive.avi", "drive"])
def test_an_unwritable_path_is_refused_before_the_first_frame(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder.mp4").mkdir()
    with pytest.raises(ConfigError, match=Path(name).name):
        VideoWriter(tmp_path / name, fps=10.0)


@pytest.mark.parametrize("fps", [0.0, -1.0, float("nan"), float("inf")])
def test_an_invalid_frame_rate_is_refused(tmp_path: Path, fps: float) -> None:
    with pytest.raises(ConfigError, match="fps"):
        VideoWriter(tmp_path / "drive.mp4", fps)


@pytest.mark.parametrize(
    "frame",
    [
        np.zeros((64, 64, 3)),
        np.zeros((64, 64), dtype=np.uint8),
        np.zeros((64, 64, 4), dtype=np.uint8),
        np.zeros((32, 64, 3), dtype=np.uint8),
    ],
)
def test_a_frame_of_another_shape_or_type_is_refused(tmp_path: Path, frame: np.ndarray) -> None:
    with VideoWriter(tmp_path / "drive.mp4", fps=10.0) as video:
        video.write(np.zeros((64, 64, 3), dtype=np.uint8))
        with pytest.raises(ConfigError, match="frame"):
            video.write(frame)


def test_the_error_without_imageio_ffmpeg_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(module: str) -> None:
        raise ModuleNotFoundError(f"No module named '{module}'", name=module)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(MissingExtraError, match=r"pip install .*\[render\]"):
        VideoWriter(tmp_path / "drive.mp4", fps=10.0)
