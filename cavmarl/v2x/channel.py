"""Channel tables computed from the configuration: path loss, and airtime of packets."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.v2x import ChannelConfig
from cavmarl.core.math.elementary import acos, erf, exp, log10
from cavmarl.core.math.elementary_arrays import exp_all
from cavmarl.core.math.walls import Walls
from cavmarl.v2x.kernels.v2x_channel import Channel

CARRIER_HZ = 5.9e9
LIGHT_MPS = 299_792_458.0
PREAMBLE_S = 40e-6  # IEEE 802.11p, 10 MHz channel
# The reach is the distance at which the probability of reception falls below this value.
LEAST_CHANCE = 1e-3
MAX_REACH_M = 20_000
_ROOT_2 = 1.4142135623730951
_LN_10 = 2.302585092994046
BUSY_LEVELS = 65  # number of levels of channel load in the tables of reception probabilities


def reference_loss_db() -> float:
    """Return the free-space loss at 1 m (Friis), 47.9 dB at 5.9 GHz."""
    return 20.0 * log10(4.0 * math.pi * CARRIER_HZ / LIGHT_MPS)


def chance_of_reception(config: ChannelConfig, distance_m: float, extra_db: float = 0.0) -> float:
    """Return the probability that the received power is high enough.

    The model is log-distance path loss with log-normal shadowing (Rappaport: "Wireless
    communications", 4.9; fitted to 5.9 GHz between cars by Cheng et al., IEEE JSAC 25 (8), 2007).
    The power in dB is normally distributed around P = tx - loss(1 m) - 10 n log10(d), so the
    probability is Φ((P - sensitivity) / σ).

    `config`: settings with a `path_loss_exponent` other than 0. `distance_m`: distance between the
    antennas; less than 1 m counts as 1 m. `extra_db`: additional loss, such as that of a building.
    """
    lost_db = 10.0 * config.path_loss_exponent * log10(max(distance_m, 1.0))
    power_dbm = config.tx_power_dbm - reference_loss_db() - lost_db - extra_db
    deviations = (power_dbm - config.sensitivity_dbm) / config.shadowing_db
    return 0.5 * (1.0 + erf(deviations / _ROOT_2))


def median_range_m(config: ChannelConfig) -> float:
    """Return the distance at which half of the packets are received; inf without path loss."""
    if config.path_loss_exponent == 0.0:
        return math.inf
    margin_db = config.tx_power_dbm - reference_loss_db() - config.sensitivity_dbm
    return exp(margin_db / (10.0 * config.path_loss_exponent) * _LN_10)


def airtime_s(config: ChannelConfig) -> float:
    """Return the airtime of a packet; 0 if airtime is not modelled."""
    if config.data_rate_mbps == 0.0:
        return 0.0
    return PREAMBLE_S + 8.0 * config.packet_bytes / (1e6 * config.data_rate_mbps)


def hidden_share(distance_m: float, sensing_m: float) -> float:
    """Return the share of the stations in a receiver's range that the sender does not hear.

    Sender and receiver hear stations within `sensing_m`. The density of stations is assumed to be
    uniform, so the share is the part of the receiver's circle that is outside the sender's circle.
    """
    half = 0.5 * distance_m / sensing_m
    if half >= 1.0:
        return 1.0
    return 1.0 - (acos(half) - half * math.sqrt(1.0 - half * half)) * 2.0 / math.pi


def chances_among_others(busy: float, hidden: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the probabilities (n,) that no hidden station disturbs a packet.

    The sender does not wait for hidden stations. They send at random, and a packet is lost if a
    hidden station starts within two packet times: exp(-2 G), where G is their channel load
    (Abramson: "The ALOHA system", 1970; Tobagi, Kleinrock: "Packet switching in radio channels:
    part II, the hidden terminal problem", 1975).

    Args:
        busy: share of time for which the receiver hears a station.
        hidden: (n,) shares of stations that the sender does not hear.
    """
    return exp_all(-2.0 * busy * hidden)


def _distances_m(config: ChannelConfig, sensing_m: float) -> int:
    """Return the length of a table, in whole metres."""
    end_m = config.range_m or math.inf
    if config.path_loss_exponent > 0.0:
        metre, last = 1, min(end_m, MAX_REACH_M)
        while metre < last and chance_of_reception(config, metre) >= LEAST_CHANCE:
            metre += 1
        return metre + 1
    if config.data_rate_mbps > 0.0 and sensing_m < math.inf:
        return math.ceil(min(end_m, 2.0 * sensing_m)) + 1
    return 2


def _table(config: ChannelConfig, sensing_m: float, extra_db: float) -> NDArray[np.float64]:
    """Return probabilities of reception (B, K), see `Channel`."""
    metres = range(_distances_m(config, sensing_m))
    levels = BUSY_LEVELS if config.data_rate_mbps > 0.0 else 1
    chances = np.full((levels, len(metres)), 1.0 - config.loss)
    if config.path_loss_exponent > 0.0:
        chances *= [chance_of_reception(config, metre, extra_db) for metre in metres]
    if levels > 1 and sensing_m < math.inf:
        hidden = np.array([hidden_share(metre, sensing_m) for metre in metres])
        for level in range(levels):
            busy = level / (levels - 1)
            chances[level] *= chances_among_others(busy, hidden)
    return chances


def make_channel(config: ChannelConfig, tick_s: float, walls: Walls) -> Channel:
    """Build the channel that kernels use.

    The probability of reception is (1 - loss) · `chance_of_reception` · `chances_among_others`.
    """
    reach_m = config.range_m or math.inf
    sensing_m = min(median_range_m(config), reach_m)
    clear = _table(config, sensing_m, 0.0)
    blocked = clear[:0]
    if config.building_db > 0.0:
        blocked = _table(config, sensing_m, config.building_db)
    if config.path_loss_exponent > 0.0:
        reach_m = min(reach_m, clear.shape[1] - 1.0)
    return Channel(
        reach_m=reach_m,
        sure=bool((clear == 1.0).all()),
        external=config.external,
        clear=clear,
        blocked=blocked,
        sensing_m=sensing_m,
        load=airtime_s(config) / tick_s,
        walls=walls,
    )
