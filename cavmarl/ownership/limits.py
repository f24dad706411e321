"""Deadlines of the protocol, in ticks and in counts. No clock is involved."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from cavmarl.core.errors import ConfigError


class DeadlinePolicy(StrEnum):
    """What becomes of a vehicle whose target has not confirmed after D ticks.

    FORCE hands it over with its state attached. EXTEND leaves it with the source for `grace` more
    ticks first. HOLD and REROUTE act earlier: a vehicle that is still before the border is named in
    the plan once its target has not confirmed for more than `grace` ticks, so that the runtime can
    make it wait there or turn away; one that has crossed all the same is forced after D ticks.
    These two change what vehicles do, so the divided world then equals the undivided one only as
    long as none is named.
    """

    FORCE = "force"
    EXTEND = "extend"
    HOLD = "hold"
    REROUTE = "reroute"


@dataclass(frozen=True, slots=True)
class Limits:
    """Deadlines that all parties of a run share."""

    deferral: int = 2  # ticks for which the source goes on without a confirmation (D)
    lifetime: int = 16  # ticks after which a replica that is not refreshed is dropped (K)
    attempts: int = 3  # how often a PREPARE is sent inside one tick (A)
    repeats: int = 3  # new hosts for one tick of one zone (R_max)
    backoff: int = 4  # ticks without an offer to a target that refused
    capacity: int = 100_000  # replicas that one host keeps
    policy: DeadlinePolicy = DeadlinePolicy.FORCE  # what happens after the deadline
    grace: int = 0  # ticks that a policy other than FORCE grants, behind the border or before it
    schema: int = 1  # version of the vehicles' states

    def __post_init__(self) -> None:
        least = {"deferral": 0, "lifetime": 1, "attempts": 1, "repeats": 0, "backoff": 0}
        least |= {"capacity": 0, "grace": 0, "schema": 0}
        for name, bound in least.items():
            if getattr(self, name) < bound:
                raise ConfigError(f"{name} is {getattr(self, name)}: it has to be {bound} or more")
        if (self.policy is DeadlinePolicy.FORCE) != (self.grace == 0):
            raise ConfigError(
                f"policy {self.policy} with a grace of {self.grace} ticks: "
                "'force' takes no grace, the other policies need at least 1"
            )

    @property
    def holds(self) -> bool:
        """Whether vehicles are kept from a border whose other side does not answer."""
        return self.policy in (DeadlinePolicy.HOLD, DeadlinePolicy.REROUTE)

    @property
    def longest_deferral(self) -> int:
        """Ticks that a vehicle may be with a zone that does not contain it."""
        return self.deferral if self.holds else self.deferral + self.grace
