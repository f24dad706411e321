"""CO₂ of a car by speed and acceleration."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_IDLE_MPS = 0.5  # below this speed a vehicle that brakes does not coast


def co2_mg_per_s(
    speed_mps: NDArray[np.float64], accel_mps2: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the CO₂ in mg/s of passenger cars with petrol engines (Euro 4) on level roads.

    An engine that coasts, or brakes harder than it coasts, emits nothing.

    Source: SUMO 1.28, its default class HBEFA4/PC_petrol_Euro-4. The numbers are a fit to the
        results of its tool emissionsDrivingCycle, which they reproduce within 0.1 mg/s.

    Args:
        speed_mps: (n,) speeds.
        accel_mps2: (n,) accelerations.
    """
    v, a = speed_mps, accel_mps2
    rate = 1521.0023 + 15.5894 * v + 695.0992 * a + 0.1199 * v**3 + (132.5001 + 3.434 * v) * a * v
    coasting_mps2 = -np.minimum(0.0515 * v, 0.1065 + 0.013 * v)
    coasts = (v > _IDLE_MPS) & (a < coasting_mps2)
    return np.where(coasts, 0.0, np.maximum(rate, 0.0))
