"""`SignalsConfig`: signals that the caller controls."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from cavmarl.config.checks import Section, Whole


@dataclass(frozen=True)
class SignalsConfig(Section, key="signals"):
    """Signals that the caller controls.

    Attributes:
        overrides: number of links at whose signals the caller may show states of its own in a world
            at the same time (`SignalOverrides`).
    """

    overrides: Annotated[int, Whole(0, 100_000)] = 0
