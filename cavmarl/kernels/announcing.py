"""How far ahead a vehicle is known to come: those before it at a junction ask for no others."""

from __future__ import annotations

from cavmarl.kernels import inlined_kernel

__all__ = ["APPROACH_M", "announced_m"]

APPROACH_M = 150.0  # how far ahead a vehicle announces itself at most,
APPROACH_S = 8.0  # which it does this time before it arrives,
APPROACH_STANDING_M = 30.0  # and this far ahead in any case


@inlined_kernel
def announced_m(speed: float) -> float:
    """The distance in m of its centre to a line from which on a vehicle is listed there."""
    return min(APPROACH_STANDING_M + APPROACH_S * speed, APPROACH_M)
