"""`VideoWriter`: writes pictures to an MP4 file that all browsers can play."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, require

# Constant rate factor of x264: lower is better and larger; 18 is visually lossless, 23 the default.
QUALITY = 20


class VideoWriter:
    """Writes uint8 frames to an H.264 file (yuv420p); use it in a `with` block.

    Missing folders are created. The first frame sets the size; without frames, no file is written.

    `path`: ends in `.mp4`.

    Raises ConfigError: the path is not writable or does not end in `.mp4`; MissingExtraError:
    imageio-ffmpeg is not installed.
    """

    def __init__(self, path: str | Path, fps: float) -> None:
        self.path = Path(path)
        self.fps = fps
        self.num_frames = 0
        self._shape: tuple[int, ...] = ()
        self._sink: Generator[None, bytes, None] | None = None
        self._ffmpeg = require("imageio_ffmpeg", "render")
        if self.path.suffix != ".mp4":
            raise ConfigError(f"{path}: the name of a video must end in .mp4")
        if not 0.0 < fps <= 240.0:
            raise ConfigError(f"fps = {fps!r}: must be above 0 and at most 240")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("ab"):
                pass
        except OSError as error:
            raise self._unwritable(error) from error
        if not self.path.stat().st_size:
            self.path.unlink()

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def write(self, frame: NDArray[np.uint8]) -> None:
        """Append a frame, (height, width, 3).

        Raises ConfigError: the frame is not uint8 (height, width, 3) or has another size than the
        first frame, or the file cannot be written.
        """
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
            raise ConfigError(
                f"frame of {frame.dtype} {frame.shape}: must be uint8 (height, width, 3)"
            )
        if self._sink is None:
            self._shape = frame.shape
            self._sink = self._open(frame.shape)
        if frame.shape != self._shape:
            raise ConfigError(f"frame of {frame.shape}: the first frame has {self._shape}")
        # yuv420p has one colour per four pixels, so odd sides are padded by repeating the last
        # line.
        height, width = frame.shape[:2]
        even = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        try:
            self._sink.send(np.ascontiguousarray(even).tobytes())
        except OSError as error:
            raise self._unwritable(error) from error
        self.num_frames += 1

    def close(self) -> None:
        if self._sink is not None:
            self._sink.close()
            self._sink = None

    def _open(self, shape: tuple[int, ...]) -> Generator[None, bytes, None]:
        size = (shape[1] + shape[1] % 2, shape[0] + shape[0] % 2)
        sink: Generator[None, bytes, None] = self._ffmpeg.write_frames(
            str(self.path),
            size,
            fps=self.fps,
            codec="libx264",
            pix_fmt_in="rgb24",
            pix_fmt_out="yuv420p",
            macro_block_size=1,
            quality=None,
            output_params=["-crf", str(QUALITY), "-movflags", "+faststart"],
            ffmpeg_log_level="error",
        )
        sink.send(None)  # type: ignore[arg-type]  # starts the generator
        return sink

    def _unwritable(self, error: OSError) -> ConfigError:
        reason = error.strerror or error
        return ConfigError(f"{self.path}: cannot write a video there: {reason}")
