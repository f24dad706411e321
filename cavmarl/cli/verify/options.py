"""Options that several checks of `cavmarl verify` share."""

from __future__ import annotations

from typing import Annotated

from cavmarl.cli.output import about
from cavmarl.core.errors import ConfigError

ZoneCount = Annotated[int | None, about("Number of zones of each world.", "--zones", metavar="K")]
Check = Annotated[
    bool, about("Also check the invariants of ownership after every tick.", "--check")
]


def counts_of(option: str, text: str) -> list[int]:
    """Return the numbers of a list such as 1,2,4. Raises ConfigError: it is none."""
    try:
        return [int(word) for word in text.split(",")]
    except ValueError:
        raise ConfigError(f"{option} {text}: must be numbers with commas between, 1,2,4") from None
