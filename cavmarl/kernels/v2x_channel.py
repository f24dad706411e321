"""Whether a packet is received: range, path loss, buildings, other packets, and chance.

Who draws a number for a packet is the pair (sender, receiver), the tick and the kind: it does not
matter in which order, or in which zone, anybody asks.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.kernels import kernel
from cavmarl.kernels.rng import STREAM_V2X, mix, quick_uniform
from cavmarl.kernels.walls import Walls, is_cut

__all__ = [
    "Channel",
    "draw",
    "gets_access",
    "hidden_share",
    "is_equipped",
    "is_heard",
    "packet_word",
    "receiver_word",
]

STREAM_ACCESS = STREAM_V2X + 16  # one a kind of packet
STREAM_EQUIPPED = STREAM_V2X + 32

# SplitMix64's increment, as in `rng`.
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_SHIFT_11 = np.uint64(11)
_SHIFT_32 = np.uint64(32)
_ULP = 1.0 / (1 << 53)


class Channel(NamedTuple):
    """The air; see `v2x.channel.make_channel`."""

    reach_m: float  # nobody further away receives anything; inf: no limit
    sure: bool  # who is within reach receives
    external: bool  # somebody else says who receives
    loss: float  # share of packets that is lost, whatever else
    clear: NDArray[np.float64]  # (K,) chance of reception at 0, 1, 2 … m in the line of sight
    blocked: NDArray[np.float64]  # (K,) behind a building; (1,): buildings do not matter
    sensing_m: float  # up to where one hears that somebody sends
    load: float  # share of a tick that a packet takes; 0: the air takes any number
    walls: Walls


@kernel
def receiver_word(key: np.uint64, receiver: int) -> np.uint64:
    """A receiver's half of its random numbers.

    Args:
        key: of the world.
        receiver: station.
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
def hidden_share(distance_m: float, sensing_m: float) -> float:
    """Of those whom a receiver hears the share that the sender does not: part of a circle.

    Both hear what is within `sensing_m` of themselves; traffic is taken to be as dense everywhere.
    """
    half = 0.5 * distance_m / sensing_m
    if half >= 1.0:
        return 1.0
    return 1.0 - (math.acos(half) - half * math.sqrt(1.0 - half * half)) * 2.0 / math.pi


@kernel
def _at(table: NDArray[np.float64], distance_m: float) -> float:
    """A table's value at a distance, between those of whole metres; 0 beyond its end."""
    below = int(distance_m)
    if below + 1 >= table.size:
        return 0.0
    return float(table[below] + (table[below + 1] - table[below]) * (distance_m - below))


@kernel
def is_heard(
    channel: Channel,
    number: float,
    busy: float,
    x: float,
    y: float,
    from_x: float,
    from_y: float,
    distance_m: float,
) -> bool:
    """Whether a packet within reach is received.

    The chance is (1 - loss) · P(distance) · exp(-2 · busy · hidden). P is that of the path-loss
    model. The last factor is that of packets of stations which the sender cannot hear and so does
    not wait for, if they send at random: two packet times in which nobody else may begin
    (Tobagi, Kleinrock: "Packet switching in radio channels: part II", IEEE Trans. Commun., 1975).

    Args:
        channel: the air.
        number: of `draw`.
        busy: share of the time in which the receiver hears others.
        x: m, the receiver's place.
        y: likewise.
        from_x: m, the sender's.
        from_y: likewise.
        distance_m: between them.
    """
    chance = 1.0 - channel.loss
    if channel.load == 0.0 and channel.clear.size == 1:
        return number < chance
    if channel.load > 0.0 and channel.sensing_m != math.inf:
        hidden = hidden_share(distance_m, channel.sensing_m)
        chance *= math.exp(-2.0 * min(busy, 1.0) * hidden)
    if channel.clear.size == 1:
        return number < chance
    if number >= chance * _at(channel.clear, distance_m):
        return False
    if channel.blocked.size == 1 or number < chance * _at(channel.blocked, distance_m):
        return True
    return not is_cut(channel.walls, x, y, from_x, from_y)
