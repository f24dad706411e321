"""Compute the sending and reception of messages from the definitions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np

from cavmarl.config.v2x import ChannelConfig
from cavmarl.core.math.rng import mix

GOLDEN = 0x9E3779B97F4A7C15
STREAM_V2X = 11 << 16
MASK = (1 << 64) - 1


@dataclass(frozen=True)
class Said:
    """A report of a vehicle."""

    subject: int
    sender: int
    tick: int
    x: float
    y: float
    cam: bool

    @property
    def rank(self) -> tuple[int, int, int]:
        """Return the sort key of a report: newest, then by its subject, then lowest sender."""
        return (-self.tick, 0 if self.cam else 1, self.sender)


def finalised(word: int) -> int:
    return int(mix(np.uint64(word & MASK)))


def number(key: int, receiver: int, sender: int, tick: int, kind: int) -> float:
    """Return the random number of a reception, in [0, 1)."""
    of_receiver = finalised(finalised(key + GOLDEN) ^ (receiver * GOLDEN & MASK))
    stream = ((STREAM_V2X + kind) << 32) + tick
    of_packet = finalised(finalised(sender * GOLDEN) ^ (stream * GOLDEN & MASK))
    return (finalised(of_receiver ^ of_packet) >> 11) / (1 << 53)


def chance(config: ChannelConfig, distance_m: float, blocked: bool, busy: float) -> float:
    """Return the probability of a reception, by the formulas of docs/reference/v2x.md."""
    result = 1.0 - config.loss
    if config.path_loss_exponent > 0.0:
        lost = 10.0 * config.path_loss_exponent * math.log10(max(distance_m, 1.0))
        lost += config.building_db if blocked else 0.0
        result *= NormalDist().cdf((_margin_db(config) - lost) / config.shadowing_db)
    if config.data_rate_mbps > 0.0:
        sensing = sensing_m(config)
        if sensing < math.inf:
            half = min(0.5 * distance_m / sensing, 1.0)
            shared = 2.0 / math.pi * (math.acos(half) - half * math.sqrt(1.0 - half * half))
            result *= math.exp(-2.0 * busy * (1.0 - shared))
    return result


def airtime_s(config: ChannelConfig) -> float:
    """Return the airtime of IEEE 802.11p in 10 MHz: 32 µs training, 8 µs header, then data."""
    if config.data_rate_mbps == 0.0:
        return 0.0
    return 32e-6 + 8e-6 + config.packet_bytes * 8 / (config.data_rate_mbps * 1e6)


def sensing_m(config: ChannelConfig) -> float:
    """Return the distance at which half of the packets are received, at most the range."""
    sensing = config.range_m or math.inf
    if config.path_loss_exponent > 0.0:
        sensing = min(sensing, 10.0 ** (_margin_db(config) / (10.0 * config.path_loss_exponent)))
    return sensing


def _margin_db(config: ChannelConfig) -> float:
    """Return the path loss beyond the first metre, in dB, at which half of the packets are lost."""
    loss_1m = 20.0 * math.log10(4.0 * math.pi * 5.9e9 / 299_792_458.0)
    return config.tx_power_dbm - loss_1m - config.sensitivity_dbm


def inbox(
    old: Sequence[Said], heard: Sequence[Said], receiver: int, x: float, y: float, most: int
) -> list[Said]:
    """Return the best report of each of the nearest subjects, sorted by distance and subject."""
    best: dict[int, Said] = {}
    for said in (*old, *heard):
        if said.subject == receiver:
            continue
        known = best.get(said.subject)
        if known is None or said.rank < known.rank:
            best[said.subject] = said

    # A known vehicle stays until nearer vehicles replace it, even if it is out of range now.
    def key(said: Said) -> tuple[float, int]:
        return ((said.x - x) ** 2 + (said.y - y) ** 2, said.subject)

    return sorted(best.values(), key=key)[:most]


def seen(
    rows: Any, own: int, x: float, y: float, range_m: float, most: int, bodies: bool
) -> list[int]:
    """Return the rows of vehicles that are visible from (x, y), by sampling lines of sight."""
    places = [
        (math.hypot(row["x"] - x, row["y"] - y), int(row["id"]), k)
        for k, row in enumerate(rows)
        if k != own
    ]
    places = sorted(place for place in places if place[0] <= range_m)
    found = []
    for rank, (_, _, k) in enumerate(places):
        nearer = [other for _, _, other in places[:rank]]
        if bodies and any(_meets(rows[o], x, y, rows[k]["x"], rows[k]["y"]) for o in nearer):
            continue
        found.append(k)
        if len(found) == most:
            break
    return found


def _meets(row: Any, x: float, y: float, to_x: float, to_y: float) -> bool:
    """Return whether one of 2,000 points on a line is inside the rectangle of a body."""
    share = np.linspace(0.0, 1.0, 2001)
    dx, dy = x + share * (to_x - x) - row["x"], y + share * (to_y - y) - row["y"]
    cos, sin = math.cos(row["heading"]), math.sin(row["heading"])
    along, across = np.abs(dx * cos + dy * sin), np.abs(dy * cos - dx * sin)
    return bool(((along < 0.5 * row["length"]) & (across < 0.5 * row["width"])).any())


def crosses(wall: Sequence[float], x: float, y: float, to_x: float, to_y: float) -> bool:
    """Return whether two segments intersect, by solving for the point."""
    ax, ay, bx, by = wall
    det = (to_x - x) * (by - ay) - (to_y - y) * (bx - ax)
    if det == 0.0:
        return False
    t = ((ax - x) * (by - ay) - (ay - y) * (bx - ax)) / det
    u = ((ax - x) * (to_y - y) - (ay - y) * (to_x - x)) / det
    return 0.0 <= t <= 1.0 and 0.0 <= u <= 1.0
