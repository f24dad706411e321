"""A substitute for moviepy, which recorders of other libraries use to write videos."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import pytest
from numpy.typing import NDArray


class Video:
    """A video that a recorder has written: its frames and the frame rate."""

    written: list[Video]

    def __init__(self, frames: Sequence[NDArray[Any]], fps: float) -> None:
        self.frames, self.fps = list(frames), fps

    def write_videofile(self, *_: Any, **__: Any) -> None:
        self.written.append(self)


@pytest.fixture
def recorded(monkeypatch: pytest.MonkeyPatch) -> list[Video]:
    """Collect the videos that the recorders of a test write, instead of files."""
    pytest.importorskip("pygame", reason="needs the extra: render")
    Video.written = []
    clips = ModuleType("moviepy.video.io.ImageSequenceClip")
    clips.ImageSequenceClip = Video  # type: ignore[attr-defined]
    for name in ("moviepy", "moviepy.video", "moviepy.video.io"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setitem(sys.modules, clips.__name__, clips)
    return Video.written
