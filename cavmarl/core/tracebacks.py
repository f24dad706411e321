"""Tracebacks of faults in the code of users: without the frames of the program that called it."""

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
    """An exception as Python prints it, from the first line on that is a user's.

    Where none is, all of it: the fault is that of the program.
    """
    shown = _from_users_code(error.__traceback__) or error.__traceback__
    return "".join(traceback.format_exception(type(error), error, shown))


def fault_in(file: Path, error: Exception) -> str:
    """What a file of a user has raised while it was read, with the file and line."""
    said = f"{type(error).__name__}: {error}"
    if isinstance(error, SyntaxError):
        place = f"{error.filename or file}, line {error.lineno}"
        return f"{place}: {type(error).__name__}: {error.msg}"
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if not _is_foreign(frame.filename)]
    return f"{own[-1].filename}, line {own[-1].lineno}: {said}" if own else f"{file}: {said}"


def _from_users_code(frames: TracebackType | None) -> TracebackType | None:
    while frames is not None and _is_foreign(frames.tb_frame.f_code.co_filename):
        frames = frames.tb_next
    return frames


def _is_foreign(path: str) -> bool:
    """Whether a file is of the package, of a library, or the program that was started."""
    if path.startswith("<") or os.path.realpath(path) == os.path.realpath(sys.argv[0]):
        return True
    return path.startswith(_FOREIGN)
