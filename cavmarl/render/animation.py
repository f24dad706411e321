"""`AnimationWriter`: writes pictures to an animated WebP file, which a page can contain."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, require


class AnimationWriter:
    """Writes uint8 frames to an animated WebP file that repeats; use it in a `with` block.

    All frames stay in memory until the end, reduced to 256 colours each: use `VideoWriter` for more
    than a few hundred frames. Without frames, no file is written.

    `path`: ends in `.webp`.

    Raises ConfigError: the path is not writable or does not end in `.webp`; MissingExtraError:
    Pillow is not installed.
    """

    def __init__(self, path: str | Path, fps: float) -> None:
        self.path = Path(path)
        self._image = require("PIL.Image", "demo")
        self._frame_ms = 1000.0 / fps
        self._frames: list[Any] = []
        if self.path.suffix != ".webp":
            raise ConfigError(f"{path}: the name of an animation must end in .webp")

    def __enter__(self) -> AnimationWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def write(self, frame: NDArray[np.uint8]) -> None:
        """Append a frame, (height, width, 3), of the size of the first frame."""
        self._frames.append(self._image.fromarray(frame).quantize())

    def close(self) -> None:
        """Write the file."""
        if not self._frames:
            return
        first, *others = self._frames
        self._frames = []
        try:
            first.save(self.path, save_all=True, append_images=others, duration=self._frame_ms,
                       loop=0, quality=70, method=2)  # fmt: skip
        except OSError as error:
            reason = error.strerror or error
            raise ConfigError(f"{self.path}: cannot write an animation there: {reason}") from error
