"""A substitute for moviepy, with which recorders of other libraries write videos."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import pytest
from numpy.typing import NDArray


class Video:
    """A video from a recorder: its frames and its frame rate."""

    written: list[Video]

    def __init__(self, frames: Sequence[NDArray[Any]], fps: float) -> None:
        self.frames, self.fps = list(frames), fps

    def write_videofile(self, *_: Any, **__: Any) -> None:
        self.written.append(self)


@pytest.fixture
def recorded(monkeypatch: pytest.MonkeyPatch) -> list[Video]:
    """Return the list of videos that recorders write during a test; no file is written."""
    pytest.importorskip("pygame", reason="needs the extra: render")
    Video.written = []
    clips = ModuleType("moviepy.video.io.ImageSequenceClip")
    clips.ImageSequenceClip = Video  # type: ignore[attr-defined]
    for name in ("moviepy", "moviepy.video", "moviepy.video.io"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setitem(sys.modules, clips.__name__, clips)
    return Video.written
