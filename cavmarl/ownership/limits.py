"""Deadlines of the protocol, in ticks and in counts. No clock is involved."""

from __future__ import annotations

from dataclasses import dataclass

from cavmarl.core.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Limits:
    """Deadlines that all parties of a run share."""

    # Ticks for which the source keeps a vehicle that has crossed the border, if the target has not
    # acknowledged its state (D). Afterwards, the vehicle is handed over with its state attached.
    deferral: int = 2
    lifetime: int = 16  # ticks after which a replica that is not refreshed is dropped (K)
    attempts: int = 3  # number of times that a PREPARE is sent in one tick (A)
    repeats: int = 3  # limit of new hosts for one tick of one zone (R_max)
    backoff: int = 4  # ticks after a refusal without a new offer of the vehicle to the target
    capacity: int = 100_000  # limit of the replicas that one host keeps
    schema: int = 1  # version of the vehicles' states

    def __post_init__(self) -> None:
        least = {"deferral": 0, "lifetime": 1, "attempts": 1, "repeats": 0, "backoff": 0}
        least |= {"capacity": 0, "schema": 0}
        for name, bound in least.items():
            if getattr(self, name) < bound:
                raise ConfigError(f"{name} = {getattr(self, name)}: must be at least {bound}")
