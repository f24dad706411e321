"""Tracebacks of errors in users' code, without the frames of the program that called it."""

from __future__ import annotations

import os
import sys
import sysconfig
import traceback
from pathlib import Path
from types import TracebackType

_FOREIGN = tuple(
    os.path.join(folder, "")
    for folder in (
        str(Path(__file__).resolve().parents[1]),
        *(sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")),
    )
)


def print_traceback(error: BaseException) -> None:
    """Print `traceback_text` on standard error."""
    print(traceback_text(error), end="", file=sys.stderr, flush=True)


def traceback_text(error: BaseException) -> str:
    """Return an exception as Python prints it, starting at the first frame of a user's code.

    If there is no such frame, the error is in the program, and all frames are included.
    """
    shown = _from_users_code(error.__traceback__) or error.__traceback__
    return "".join(traceback.format_exception(type(error), error, shown))


def fault_in(file: Path, error: Exception) -> str:
    """Return a message with file and line for an error that occurred while reading a file."""
    message = f"{type(error).__name__}: {error}"
    if isinstance(error, SyntaxError):
        place = f"{error.filename or file}, line {error.lineno}"
        return f"{place}: {type(error).__name__}: {error.msg}"
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if not _is_foreign(frame.filename)]
    return f"{own[-1].filename}, line {own[-1].lineno}: {message}" if own else f"{file}: {message}"


def _from_users_code(frames: TracebackType | None) -> TracebackType | None:
    while frames is not None and _is_foreign(frames.tb_frame.f_code.co_filename):
        frames = frames.tb_next
    return frames


def _is_foreign(path: str) -> bool:
    """Return whether a file belongs to the package or a library, or is the started program."""
    if path.startswith("<") or os.path.realpath(path) == os.path.realpath(sys.argv[0]):
        return True
    return path.startswith(_FOREIGN)
