"""Whether a packet is received: range, path loss, buildings, other packets, and chance.

A packet's random number depends on the pair (sender, receiver), the tick and the kind, and not
on the order or the zone in which it is drawn.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.rng import STREAM_V2X, mix, quick_uniform
from cavmarl.core.math.walls import Walls, is_cut

STREAM_ACCESS = STREAM_V2X + 16  # one a kind of packet
STREAM_EQUIPPED = STREAM_V2X + 32

# SplitMix64's increment, as in `rng`.
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_SHIFT_11 = np.uint64(11)
_SHIFT_32 = np.uint64(32)
_ULP = 1.0 / (1 << 53)


class Channel(NamedTuple):
    """The air; see `v2x.channel.make_channel`.

    Chances of reception are tables of B levels of busy air by whole metres, from 0 m on; in between
    they change evenly, and the last but one and the last hold for all that is further away.
    """

    reach_m: float  # no reception further away; inf: no limit
    sure: bool  # all within reach receive
    external: bool  # a network simulator decides receptions
    clear: NDArray[np.float64]  # (B, K) in the line of sight
    blocked: NDArray[np.float64]  # (B, K) behind a building; (0, K): buildings do not matter
    sensing_m: float  # up to where a station hears that another sends
    load: float  # share of a tick that a packet takes; 0: the air takes any number
    walls: Walls


@kernel
def receiver_word(key: np.uint64, receiver: int) -> np.uint64:
    """A receiver's half of its random numbers.

    `receiver`: station.
    """
    return mix(mix(np.uint64(key) + _GOLDEN) ^ (np.uint64(receiver) * _GOLDEN))


@kernel
def packet_word(sender: int, tick: int, kind: int) -> np.uint64:
    """A packet's half of the random numbers of its receptions."""
    stream = (np.uint64(STREAM_V2X + kind) << _SHIFT_32) + np.uint64(tick)
    return mix(mix(np.uint64(sender) * _GOLDEN) ^ (stream * _GOLDEN))


@kernel
def draw(of_receiver: np.uint64, of_packet: np.uint64) -> float:
    """The number of one reception, uniform in [0, 1)."""
    return float(mix(of_receiver ^ of_packet) >> _SHIFT_11) * _ULP


@kernel
def is_equipped(key: np.uint64, vehicle: int, share: float) -> bool:
    """Whether a background vehicle sends, of which `share` does."""
    return share >= 1.0 or quick_uniform(key, vehicle, 0, STREAM_EQUIPPED) < share


@kernel
def gets_access(key: np.uint64, sender: int, tick: int, kind: int, busy: float) -> bool:
    """Whether a packet gets on the air within its tick.

    Stations wait until the air is free (CSMA). Where more is to be sent than the air can carry,
    `busy` > 1, as much gets on it as it can carry; what does not is out of date and given up.
    """
    return busy <= 1.0 or quick_uniform(key, sender, tick, STREAM_ACCESS + kind) * busy < 1.0


@kernel
def busy_level(channel: Channel, busy: float) -> int:
    """The row of the tables for a share of the time in which the air is busy, from 0 to 1."""
    return int(busy * (channel.clear.shape[0] - 1) + 0.5)


@kernel
def chance_at(chances: NDArray[np.float64], distance_m: float) -> float:
    """A table's chance (K,) at a distance."""
    below = min(int(distance_m), chances.size - 2)
    low = chances[below]
    return float(low + (chances[below + 1] - low) * (distance_m - below))


@kernel
def is_heard(
    channel: Channel,
    level: int,
    number: float,
    x: float,
    y: float,
    from_x: float,
    from_y: float,
    distance_m: float,
) -> bool:
    """Whether a packet within reach is received.

    `level`: of `busy_level`. `number`: of `draw`. `x`: m, the receiver's place. `from_x`: m, the
    sender's. `distance_m`: between them.
    """
    if number >= chance_at(channel.clear[level], distance_m):
        return False
    # What is received even behind a building needs no look whether one is there.
    if channel.blocked.shape[0] == 0 or number < chance_at(channel.blocked[level], distance_m):
        return True
    return not is_cut(channel.walls, x, y, from_x, from_y)
