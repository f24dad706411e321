"""Runs netconvert as a process, and reads its output."""

from __future__ import annotations

import os
import re
import subprocess
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cavmarl.core.errors import MapError, require
from cavmarl.core.processes import dying_with_parent
from cavmarl.roads.sumo_net.xml_source import limit

MAX_NETCONVERT_S = 600
TIME_LIMIT = "CAVMARL_MAX_NETCONVERT_S"  # environment variable that changes this limit
MAX_NETCONVERT_BYTES = 1 << 33
MEMORY_LIMIT = "CAVMARL_MAX_NETCONVERT_BYTES"  # environment variable that changes this limit
_OUT_OF_MEMORY = "bad_alloc"
_SHOWN_LINES = 10
_QUOTED = re.compile(r"'[^']*'")
_NUMBERED = re.compile(r"\S*\d\S*")
_CORRECTION = re.compile(r"^(Joined|Guessed|Removed) |^[1-9]\d* .*(removed|computed|split|added)$")


class BuildLog:
    """The output of netconvert with `--verbose` and without aggregated warnings."""

    def __init__(self, stdout: str = "", stderr: str = "") -> None:
        self._stdout = stdout.splitlines()
        self._stderr = stderr.splitlines()

    def errors(self) -> tuple[str, ...]:
        return self._after("Error: ")

    def warnings(self) -> dict[str, int]:
        """Return counts of warnings, by their text with `%` for names and numbers."""
        kinds = Counter(
            _NUMBERED.sub("%", _QUOTED.sub("'%'", line)) for line in self._after("Warning: ")
        )
        return dict(kinds.most_common())

    def corrections(self) -> tuple[str, ...]:
        """Return netconvert's messages about its changes to the network."""
        lines = (line.strip().rstrip(".") for line in self._stdout if line.startswith(" "))
        return tuple(line for line in lines if _CORRECTION.search(line))

    def complaint(self) -> tuple[str, ...]:
        """Return the errors or, if there are none, the complete error output."""
        return self.errors() or tuple(self._stderr) or ("no message",)

    def _after(self, prefix: str) -> tuple[str, ...]:
        return tuple(line.removeprefix(prefix) for line in self._stderr if line.startswith(prefix))


@dataclass(frozen=True)
class Cures:
    """Advice for error messages."""

    too_long: str = f"allow more time ({TIME_LIMIT})"
    too_large: str = f"allow more memory ({MEMORY_LIMIT}, in bytes)"
    refused: str = "repair the source"


def run_netconvert(
    arguments: Sequence[str], source: Path, timeout_s: float | None, cures: Cures = Cures()
) -> BuildLog:
    """Run netconvert of the `eclipse-sumo` wheel; `CAVMARL_MAX_NETCONVERT_BYTES` limits its memory.

    `source`: the map file, for messages. `timeout_s`: time limit; None: `CAVMARL_MAX_NETCONVERT_S`,
    or 600 s. `cures`: advice for messages.

    Raises:
        ConfigError: an environment variable is not a whole number above 0.
        MapError: netconvert fails, takes too long, or needs too much memory.
        MissingExtraError: netconvert is not installed.
    """
    timeout_s = limit(TIME_LIMIT, MAX_NETCONVERT_S) if timeout_s is None else timeout_s
    most_bytes = limit(MEMORY_LIMIT, MAX_NETCONVERT_BYTES)
    home = sumo_home()
    command = [str(home / "bin" / "netconvert"), *arguments]
    command += ["--verbose", "--aggregate-warnings=1000000", "--xml-validation=never"]
    projections = str(home / "data" / "proj")
    own = {"SUMO_HOME": str(home), "PROJ_DATA": projections, "PROJ_LIB": projections}
    try:
        done = subprocess.run(
            dying_with_parent(command, most_bytes),
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout_s,
            env=os.environ | own,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise MapError(
            f"{source}: netconvert took longer than {timeout_s:g} s: {cures.too_long}"
        ) from error
    log = BuildLog(done.stdout, done.stderr)
    if done.returncode != 0 and _OUT_OF_MEMORY in done.stderr:
        raise MapError(
            f"{source}: netconvert needs more than {most_bytes / 2**30:g} GiB of memory: "
            f"{cures.too_large}"
        )
    if done.returncode != 0:
        raise MapError(
            f"{source}: netconvert failed (exit code {done.returncode}):\n"
            f"{quoted(log.complaint())}\nCure: {cures.refused}"
        )
    return log


def sumo_home() -> Path:
    """Return the home folder of SUMO; raises MissingExtraError if SUMO is not installed."""
    return Path(require("sumo", "sumo").SUMO_HOME)


def quoted(lines: Sequence[str]) -> str:
    """Return an indented list of the first lines, and the number of the others."""
    shown = [f"  {line}" for line in lines[:_SHOWN_LINES]]
    if len(lines) > _SHOWN_LINES:
        shown.append(f"  … and {len(lines) - _SHOWN_LINES} more")
    return "\n".join(shown)
