"""Runs programs with the Python that has CARLA's client.

The client's library can abort its process, and does not exist for every version of Python.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from cavmarl.core.errors import CavmarlError, MissingExtraError
from cavmarl.core.processes import dying_with_parent
from cavmarl.cosim.carla.carla_versions import DEFAULT_VERSION
from cavmarl.handoff.simulators.carla_zone import PYTHON

_ABSENT = "No module named 'carla'"
_QUOTED_LINES = 5


class ClientProgramError(CavmarlError):
    """A program with CARLA's client has failed, or takes too long."""


def client_python() -> str:
    """Return the Python that has CARLA's client.

    Raises MissingExtraError: the client is not installed.
    """
    found = os.environ.get(PYTHON)
    if found:
        return found
    if find_spec("carla") is None:
        raise _missing(sys.executable)
    return sys.executable


def run_client_program(
    program: Path, arguments: Sequence[object] = (), timeout_s: float = 600.0
) -> None:
    """Run a program file with CARLA's client.

    Raises:
        ClientProgramError: the program fails, aborts, or takes longer than `timeout_s`.
        MissingExtraError: the client is not installed.
    """
    python = client_python()
    command = [python, str(program), *map(str, arguments)]
    try:
        done = subprocess.run(
            dying_with_parent(command),
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout_s,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise ClientProgramError(
            f"{python}: CARLA's client took longer than {timeout_s:g} s"
        ) from error
    except OSError as error:
        raise _missing(python) from error
    if done.returncode == 0:
        return
    if _ABSENT in done.stderr or not Path(python).exists():
        raise _missing(python)
    end = f"exit code {done.returncode}"
    if done.returncode < 0:
        end = signal.Signals(-done.returncode).name
    last = "\n".join(f"  {line}" for line in done.stderr.splitlines()[-_QUOTED_LINES:])
    raise ClientProgramError(f"{python}: CARLA's client has ended with {end}:\n{last}")


def _missing(python: str) -> MissingExtraError:
    return MissingExtraError(
        f"{python}: CARLA's client is not installed: pip install carla=={DEFAULT_VERSION}, or set "
        f"{PYTHON} to a Python that has it"
    )
