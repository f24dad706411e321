"""The reception of a packet: range, path loss, buildings, interference, and chance.

A packet's random number depends on the pair (sender, receiver), the tick and the kind, but not on
the order or zone in which it is drawn.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel
from cavmarl.core.math.rng import STREAM_V2X, mix, quick_uniform
from cavmarl.core.math.walls import Walls, is_cut

STREAM_ACCESS = STREAM_V2X + 16  # first of the streams per kind of packet
STREAM_EQUIPPED = STREAM_V2X + 32

# Increment of SplitMix64, as in `rng`.
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_SHIFT_11 = np.uint64(11)
_SHIFT_32 = np.uint64(32)
_ULP = 1.0 / (1 << 53)


class Channel(NamedTuple):
    """A radio channel; see `v2x.channel.make_channel`.

    Tables of the probability of reception have a row for each of B levels of channel load and a
    column for each whole metre, starting at 0 m. Values in between are interpolated linearly; the
    last interval applies to all larger distances.
    """

    reach_m: float  # largest distance of receptions; inf: no limit
    sure: bool  # whether all receivers within reach receive
    external: bool  # whether a network simulator decides receptions
    clear: NDArray[np.float64]  # (B, K) probabilities in line of sight
    blocked: NDArray[np.float64]  # (B, K) behind a building; (0, K): buildings are ignored
    sensing_m: float  # range in which a station senses transmissions of other stations
    load: float  # share of a tick that a packet takes; 0: unlimited capacity
    walls: Walls


@kernel
def receiver_word(key: np.uint64, receiver: int) -> np.uint64:
    """Return the receiver's part of a random number; `receiver`: a station."""
    return mix(mix(np.uint64(key) + _GOLDEN) ^ (np.uint64(receiver) * _GOLDEN))


@kernel
def packet_word(sender: int, tick: int, kind: int) -> np.uint64:
    """Return the packet's part of the random numbers of its receptions."""
    stream = (np.uint64(STREAM_V2X + kind) << _SHIFT_32) + np.uint64(tick)
    return mix(mix(np.uint64(sender) * _GOLDEN) ^ (stream * _GOLDEN))


@kernel
def draw(of_receiver: np.uint64, of_packet: np.uint64) -> float:
    """Return the random number of a reception, uniform in [0, 1)."""
    return float(mix(of_receiver ^ of_packet) >> _SHIFT_11) * _ULP


@kernel
def is_equipped(key: np.uint64, vehicle: int, share: float) -> bool:
    """Return whether a background vehicle can send; `share`: share of such vehicles."""
    return share >= 1.0 or quick_uniform(key, vehicle, 0, STREAM_EQUIPPED) < share


@kernel
def gets_access(key: np.uint64, sender: int, tick: int, kind: int, busy: float) -> bool:
    """Return whether a packet gets channel access within its tick.

    Stations wait until the channel is free (CSMA). If the load `busy` exceeds 1, only as many
    packets as fit get access; the other packets become outdated and are dropped.
    """
    return busy <= 1.0 or quick_uniform(key, sender, tick, STREAM_ACCESS + kind) * busy < 1.0


@kernel
def busy_level(channel: Channel, busy: float) -> int:
    """Return the table row for a channel busy ratio from 0 to 1."""
    return int(busy * (channel.clear.shape[0] - 1) + 0.5)


@kernel
def chance_at(chances: NDArray[np.float64], distance_m: float) -> float:
    """Return the probability at a distance from a table (K,)."""
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
    """Return whether a packet within reach is received.

    `level`: from `busy_level`. `number`: from `draw`. `x`, `y`: position of the receiver, m.
    `from_x`, `from_y`: position of the sender, m. `distance_m`: distance between both.
    """
    if number >= chance_at(channel.clear[level], distance_m):
        return False
    # A packet that is received even behind a building needs no test for buildings.
    if channel.blocked.shape[0] == 0 or number < chance_at(channel.blocked[level], distance_m):
        return True
    return not is_cut(channel.walls, x, y, from_x, from_y)
