"""Function calls in new processes that share only the files on disk.

A call is pickled to the standard input of a program, which pickles progress and the result to
standard output. Unlike `multiprocessing`, this does not import the caller's script again.
"""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from typing import Any, BinaryIO, TypeVar

from cavmarl.core import errors
from cavmarl.core.processes import start_python
from cavmarl.core.tracebacks import print_traceback

Found = TypeVar("Found")
Tell = Callable[..., None]

PROGRAM = "from cavmarl.evaluate.subprocess_calls import main; main()"


def call_in_fresh_process(
    what: str,
    call: Callable[..., Found],
    *given: Any,
    hear: Tell | None = None,
    began: Callable[[subprocess.Popen[bytes]], None] | None = None,
) -> Found:
    """Return `call(*given)` from a new interpreter, or raise the CavmarlError that it raised.

    If `hear` is given, `call` gets a further argument: a function that passes its own arguments to
    `hear` in this process. If the new process dies, an `EvaluationError` names its task, `what`.
    `began` is called with the process, so that another thread can end it.
    """
    program = start_python(["-c", PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert program.stdin is not None
    assert program.stdout is not None
    if began is not None:
        began(program)
    try:
        pickle.dump((call, given, hear is not None), program.stdin)
        program.stdin.close()
        while True:
            kind, *told = pickle.load(program.stdout)
            if kind == "found":
                result: Found = told[0]
                return result
            if kind == "error":
                raise told_error(*told)
            if hear is not None:
                hear(*told)
    except (EOFError, BrokenPipeError):
        raise errors.EvaluationError(
            f"{what} ended with exit code {program.wait()}; its own message is above"
        ) from None
    except BaseException:
        program.kill()
        raise
    finally:
        program.stdout.close()
        program.wait()


def told_error(kind: str, message: str) -> errors.CavmarlError:
    """Return the error of another process; only its message was transferred."""
    found: type[errors.CavmarlError] = getattr(errors, kind)
    return found.__new__(found, message)


def main() -> None:
    """Run the program: execute a call from standard input."""
    out, sys.stdout = sys.stdout.buffer, sys.stderr
    call, given, tells = pickle.load(sys.stdin.buffer)
    try:
        found = call(*given, partial(_tell, out, "told")) if tells else call(*given)
    except errors.CavmarlError as error:
        _tell(out, "error", type(error).__name__, str(error))
    except Exception as error:
        print_traceback(error)
        sys.exit(1)
    else:
        _tell(out, "found", found)


def _tell(out: BinaryIO, *what: Any) -> None:
    pickle.dump(what, out)
    out.flush()
