"""Options shared by the checks of `cavmarl verify`."""

from __future__ import annotations

from typing import Annotated

from cavmarl.cli.output import (
    WORLD,
    about,
    flag,
)
from cavmarl.core.errors import ConfigError

ZoneCount = Annotated[
    int | None, about("Number of zones of each world.", "--zones", metavar="K", panel=WORLD)
]
Check = Annotated[bool, flag("Also check the invariants of ownership after every tick.", "--check")]


def counts_of(option: str, text: str) -> list[int]:
    """Return the numbers of a text such as 1,2,4; raise ConfigError if it is not such a list."""
    try:
        return [int(word) for word in text.split(",")]
    except ValueError:
        raise ConfigError(
            f"{option} {text}: must be numbers separated by commas, for example 1,2,4"
        ) from None
