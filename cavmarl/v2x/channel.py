"""The air, made of the configuration: tables of the path-loss model and what packets take."""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from cavmarl.config_v2x import ChannelConfig
from cavmarl.kernels.v2x_channel import Channel
from cavmarl.kernels.walls import Walls

__all__ = ["airtime_s", "chance_of_reception", "make_channel", "median_range_m", "reference_loss_db"]

CARRIER_HZ = 5.9e9
LIGHT_MPS = 299_792_458.0
PREAMBLE_S = 40e-6  # of IEEE 802.11p in a channel of 10 MHz
# Beyond the distance where fewer packets than this are received nobody asks.
LEAST_CHANCE = 1e-3


def reference_loss_db() -> float:
    """Free-space loss at 1 m (Friis), 47.9 dB at 5.9 GHz."""
    return 20.0 * math.log10(4.0 * math.pi * CARRIER_HZ / LIGHT_MPS)


def chance_of_reception(config: ChannelConfig, distance_m: float, extra_db: float = 0.0) -> float:
    """Chance that the received power is high enough.

    The log-distance model with log-normal shadowing (Rappaport: "Wireless communications", 4.9;
    fitted to 5.9 GHz between cars by Cheng et al., IEEE JSAC 25 (8), 2007): the power is normally
    distributed, in dB, around P = tx - loss(1 m) - 10 n log10(d), so that the chance is
    Φ((P - sensitivity) / σ).

    Args:
        config: of which `path_loss_exponent` is not 0.
        distance_m: between the antennas; below 1 m it counts as 1 m.
        extra_db: lost besides, in a building.
    """
    lost_db = 10.0 * config.path_loss_exponent * math.log10(max(distance_m, 1.0))
    power_dbm = config.tx_power_dbm - reference_loss_db() - lost_db - extra_db
    return NormalDist().cdf((power_dbm - config.sensitivity_dbm) / config.shadowing_db)


def median_range_m(config: ChannelConfig) -> float:
    """Distance at which half of the packets are received; inf without path loss."""
    if config.path_loss_exponent == 0.0:
        return math.inf
    margin_db = config.tx_power_dbm - reference_loss_db() - config.sensitivity_dbm
    return float(10.0 ** (margin_db / (10.0 * config.path_loss_exponent)))


def airtime_s(config: ChannelConfig) -> float:
    """For how long a packet takes the air; 0: it does not matter."""
    if config.data_rate_mbps == 0.0:
        return 0.0
    return PREAMBLE_S + 8.0 * config.packet_bytes / (1e6 * config.data_rate_mbps)


def _table(config: ChannelConfig, extra_db: float, end_m: float) -> NDArray[np.float64]:
    """Chances at 0, 1, 2 … m, up to `end_m` or where nothing is received any more."""
    chances = []
    distance_m = 0.0
    while True:
        chance = chance_of_reception(config, distance_m, extra_db)
        chances.append(chance)
        if chance < LEAST_CHANCE or distance_m > end_m:
            return np.array(chances)
        distance_m += 1.0


def make_channel(config: ChannelConfig, tick_s: float, walls: Walls) -> Channel:
    """What kernels take of a channel.

    Args:
        config: the channel.
        tick_s: seconds a tick.
        walls: of buildings.
    """
    end_m = config.range_m or math.inf
    nothing = np.ones(1)
    clear = blocked = nothing
    if config.path_loss_exponent > 0.0:
        clear = _table(config, 0.0, min(end_m, 1e5))
        if config.building_db > 0.0:
            blocked = _table(config, config.building_db, min(end_m, 1e5))
            blocked = np.append(blocked, 0.0)  # never of size 1
        end_m = min(end_m, len(clear) - 1.0)
    load = airtime_s(config) / tick_s
    return Channel(
        reach_m=end_m,
        sure=config.loss == 0.0 and clear is nothing and load == 0.0,
        external=config.external,
        loss=config.loss,
        clear=clear,
        blocked=blocked,
        sensing_m=min(median_range_m(config), config.range_m or math.inf),
        load=load,
        walls=walls,
    )
