"""Energy and CO₂ of many vehicles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.driving.kernels.emissions import write_emissions


def emissions_of(
    rows: NDArray[np.void], vclass: NDArray[np.integer], dt_s: float
) -> NDArray[np.float64]:
    """Return (n, 2): energy in Wh and CO₂ in g of vehicles during the last dt_s s.

    Args:
        rows: (n,) records with `speed`, `accel` and `pitch`, such as VEHICLE.
        vclass: (n,) class of each vehicle, see `battery_wh`.
        dt_s: time in s for which speed and acceleration are valid.
    """
    out = np.zeros((len(rows), 2))
    speed, accel, pitch = (
        np.ascontiguousarray(rows[name], np.float64) for name in ("speed", "accel", "pitch")
    )
    write_emissions(np.ascontiguousarray(vclass, np.int64), speed, accel, pitch, dt_s, out)
    return out
