"""What netconvert said, sorted into errors, warnings and corrections."""

from __future__ import annotations

import re
from collections import Counter

_QUOTED = re.compile(r"'[^']*'")
_NUMBERED = re.compile(r"\S*\d\S*")
_CORRECTION = re.compile(r"^(Joined|Guessed|Removed) |^[1-9]\d* .*(removed|computed|split|added)$")


class BuildLog:
    """The output of one run with `--verbose` and without aggregated warnings."""

    def __init__(self, stdout: str = "", stderr: str = "") -> None:
        self._said = stdout.splitlines()
        self._complained = stderr.splitlines()

    def errors(self) -> tuple[str, ...]:
        return self._after("Error: ")

    def warnings(self) -> dict[str, int]:
        """How often each warning came, by its text with `%` for names and numbers."""
        kinds = Counter(
            _NUMBERED.sub("%", _QUOTED.sub("'%'", line)) for line in self._after("Warning: ")
        )
        return dict(kinds.most_common())

    def corrections(self) -> tuple[str, ...]:
        """What netconvert changed on its own account, in its words."""
        lines = (line.strip().rstrip(".") for line in self._said if line.startswith(" "))
        return tuple(line for line in lines if _CORRECTION.search(line))

    def complaint(self) -> tuple[str, ...]:
        """The errors or, if it died without one, all that it complained about."""
        return self.errors() or tuple(self._complained) or ("no message",)

    def _after(self, prefix: str) -> tuple[str, ...]:
        return tuple(
            line.removeprefix(prefix) for line in self._complained if line.startswith(prefix)
        )
