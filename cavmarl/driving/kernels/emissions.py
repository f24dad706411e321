"""Energy and CO₂ of a vehicle by speed and acceleration, as SUMO computes them.

Every motor vehicle has both values: the energy of a battery-electric car, and the CO₂ of a car,
van, truck, bus or motorcycle with a combustion engine, by vehicle class. As in SUMO, both are 0 for
trams, bicycles and pedestrians.

Source: SUMO 1.28. Energy: the class Energy/unknown with its default parameters, which describe a
    Kia Soul EV (Kurczveil, López and Schnieder 2014), without the friction of curves. CO₂: the
    default HBEFA4 class of each vehicle class. `tests/driving/test_emissions.py` compares both
    values with SUMO's tool emissionsDrivingCycle.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.elementary import sine

GRAVITY_MPS2 = 9.80665
_MASS_KG = 1830.0
_ROTATING_KG = 40.0  # added to the mass when the car accelerates
_DRAG = 0.5 * 1.2041 * 2.6 * 0.35  # 0.5 · air density · frontal area · drag coefficient, kg/m
_ROLLING = 0.01
_DRIVE_EFFICIENCY = 0.98
_RECUPERATION_EFFICIENCY = 0.96
_CONSTANT_W = 100.0  # air conditioning and other consumers
_J_PER_WH = 3600.0

_COASTING_FROM_MPS = 10.0 / 3.6  # from 0 to this speed, the coasting deceleration grows linearly
_IDLE_MPS = 0.5  # below this speed a vehicle that brakes does not coast

# mg/s = c0 + c1·v + c2·a + c3·v² + c4·v³ + c5·a·v + c6·a·v², with v in m/s and a in m/s².
_CAR = (1521.0, 15.59, 695.1, 0.0, 0.1199, 132.5, 3.434)  # PC_petrol_Euro-4
_VAN = (1949.0, 34.07, 659.6, 0.0, 0.2332, 230.6, 8.244)  # LCV_diesel_N1-III_Euro-6ab
_TRUCK = (1936.0, 0.0, 0.0, 16.21, 0.006403, 551.1, 12.03)  # RT_le7.5t_Euro-VI_A-C
_BUS = (2775.0, 651.0, 2643.0, 0.0, 0.0, 1627.0, 0.0)  # UBus_Std_gt15-18t_Euro-VI_A-C
_MOTORCYCLE = (1405.0, 0.0, 744.2, 2.35, 0.02944, 0.0, 0.6179)  # MC_4S_gt250cc_preEuro
_NONE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
# In the order of `roads.network.VEHICLE_CLASSES`.
_CO2 = (_CAR, _TRUCK, _BUS, _MOTORCYCLE, _VAN, _VAN, _CAR, _NONE, _NONE)
_NUM_CLASSES = len(_CO2)  # pedestrians have the next index

# g of fuel per g of CO₂, in the same order: petrol, or diesel for trucks, buses and vans. In SUMO's
# tables the quotient differs by up to 0.03 % with speed and acceleration.
FUEL_PER_CO2 = (0.32418, 0.32137, 0.32137, 0.32425, 0.32137, 0.32137, 0.32418, 0.0, 0.0, 0.0)


@kernel
def battery_wh(vclass: int, speed: float, accel: float, pitch: float, dt_s: float) -> float:
    """Return the energy in Wh that an electric car draws in dt_s; negative if it recuperates.

    Args:
        vclass: index in `roads.network.VEHICLE_CLASSES`; pedestrians have the next index.
        speed: in m/s at the end of the period; negative backwards.
        accel: in m/s² along the heading, during the period.
        pitch: in rad, positive uphill.
        dt_s: duration of the period in s.
    """
    if vclass < 0 or vclass >= _NUM_CLASSES or _CO2[vclass][0] == 0.0:
        return 0.0
    v, a, up = speed, accel, pitch
    if v < 0.0:
        v, a, up = -v, -a, -up
    before = max(v - a * dt_s, 0.0)
    kinetic_j = 0.5 * (_MASS_KG + _ROTATING_KG) * (v * v - before * before)
    force_n = _MASS_KG * GRAVITY_MPS2 * (_ROLLING + sine(up)) + _DRAG * v * v
    work_j = kinetic_j + force_n * v * dt_s
    drawn_j = work_j / _DRIVE_EFFICIENCY if work_j > 0.0 else work_j * _RECUPERATION_EFFICIENCY
    return (drawn_j + _CONSTANT_W * dt_s) / _J_PER_WH


@kernel
def co2_mg_per_s(vclass: int, speed: float, accel: float, pitch: float) -> float:
    """Return the CO₂ in mg/s; arguments as for `battery_wh`.

    The result is 0 if a moving vehicle decelerates more than it would by coasting.
    """
    if vclass < 0 or vclass >= _NUM_CLASSES:
        return 0.0
    v, a, up = speed, accel, pitch
    if v < 0.0:
        v, a, up = -v, -a, -up
    climb = GRAVITY_MPS2 * sine(up)
    if v > _IDLE_MPS:
        full = max(v, _COASTING_FROM_MPS)
        coasting = -(0.1065 + 0.013 * full + climb) * v / full
        if a < min(coasting, 0.0):
            return 0.0
    c = _CO2[vclass]
    a += climb
    rate = c[0] + c[1] * v + c[2] * a + c[3] * v * v + c[4] * v * v * v
    rate += (c[5] + c[6] * v) * a * v
    return max(rate, 0.0)


@kernel
def write_emissions(
    vclass: NDArray[np.int64],  # (n,) arguments as for `battery_wh`
    speed: NDArray[np.float64],  # (n,)
    accel: NDArray[np.float64],  # (n,)
    pitch: NDArray[np.float64],  # (n,)
    dt_s: float,
    out: NDArray[np.float64],  # (n, 2) energy in Wh and CO₂ in g
) -> None:
    for i in range(len(vclass)):
        out[i, 0] = battery_wh(vclass[i], speed[i], accel[i], pitch[i], dt_s)
        out[i, 1] = 1e-3 * dt_s * co2_mg_per_s(vclass[i], speed[i], accel[i], pitch[i])
