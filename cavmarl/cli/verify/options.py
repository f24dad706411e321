"""Options shared by the checks of `cavmarl verify`."""

from __future__ import annotations

from typing import Annotated

from cavmarl.cli.output import (
    WORLD,
    about,
    flag,
)

ZoneCount = Annotated[
    int | None, about("Number of zones of each world.", "--zones", metavar="K", panel=WORLD)
]
Check = Annotated[bool, flag("Also check the invariants of ownership after every tick.", "--check")]
