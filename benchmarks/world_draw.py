"""Random worlds: a net and a demand, as a function of a seed.

A draw contains only the options of netgenerate or netconvert and the properties of the demand;
`world_files.py` creates the files.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from cavmarl.core.errors import ConfigError

Drawn = TypeVar("Drawn")

# Features of a draw with their probabilities; features can be excluded by name. Kinds of nets:
KINDS = {"grid": 0.36, "spider": 0.2, "random": 0.29, "cut": 0.15}
# Nets with narrow places, used instead of `KINDS` and drawn with separate random numbers.
NARROW = {"zipper": 0.05, "signal_pair": 0.05}
# Types of junctions, by SUMO's names. `zipper` and `unregulated` are left out, because they define
# no right of way where paths cross.
JUNCTIONS = {
    "priority": 0.26,
    "right_before_left": 0.16,
    "allway_stop": 0.12,
    "priority_stop": 0.13,
    "traffic_light": 0.24,
    "traffic_light_right_on_red": 0.09,
}
SIGNALS = {"static": 0.5, "actuated": 0.3, "delay_based": 0.2}  # control of signals
SHARES = {  # additional features of a net
    "turn_lanes": 0.2,
    "joined": 0.12,
    "perturbed": 0.2,
    "random_lanes": 0.2,
    "random_priority": 0.35,
    "one_way": 0.3,  # share of random nets
    "shared_track": 0.05,  # lanes of both directions overlap
    "turnarounds": 0.5,
    "lefthand": 0.12,
}
LEVELS = {"free": 150.0, "half": 380.0, "near_capacity": 700.0}  # vehicles/h into a junction
# Shares of vehicle classes; cuts of real maps may close roads to all classes but cars.
MIXES = {
    "cars": {"passenger": 1.0},
    "vans": {"passenger": 0.8, "delivery": 0.2},
    "all": {"passenger": 0.72, "truck": 0.1, "bus": 0.05, "motorcycle": 0.13},
}
DEPARTURES = (
    {"departLane": "first", "departSpeed": "0", "departPos": "base"},
    {"departLane": "best", "departSpeed": "max", "departPos": "base"},
    {"departLane": "best", "departSpeed": "0", "departPos": "random_free"},
)
FEATURES = frozenset(
    (*KINDS, *NARROW, *JUNCTIONS, *SIGNALS, *SHARES, *LEVELS, *MIXES, "fringe", "everywhere")
)
_SPEEDS_MPS = (8.33, 13.89, 13.89, 19.44, 27.78)
_LANES = (1, 1, 2, 2, 3, 4)  # numbers of lanes; each entry is equally likely


@dataclass(frozen=True)
class NetDraw:
    """The properties of a net."""

    kind: str  # one of `KINDS` or `NARROW`
    options: tuple[str, ...]  # options of netgenerate, or of netconvert for a cut or a zipper
    length_m: float  # length of a typical edge, or half the side of a cut
    num_lanes: int  # upper bound of lanes per edge, in netgenerate's nets


@dataclass(frozen=True)
class DemandDraw:
    """The properties of a demand."""

    junction_per_h: float  # vehicles per hour into a typical junction, per lane
    fringe: bool  # whether trips begin and end at the net's ends, if it has any
    shares: dict[str, float]  # shares of vehicle classes
    departure: dict[str, str]  # attributes of departure


@dataclass(frozen=True)
class WorldDraw:
    """One random world."""

    seed: int  # seed of the draw
    features: tuple[str, ...]  # the drawn `FEATURES`
    net: NetDraw
    demand: DemandDraw


def draw_world(seed: int, without: Collection[str] = ()) -> WorldDraw:
    """Draw a world; equal arguments give an equal world.

    Args:
        seed: seed of all draws.
        without: features to exclude.

    Raises:
        ConfigError: a feature is unknown, or no choice is left.
    """
    check_features(without)
    chance = _Chance(seed, without)
    kind = _narrow(seed, without)
    if kind:
        chance.features.append(kind)
        net = _zipper(chance) if kind == "zipper" else _signal_pair(chance)
    else:
        kind = chance.one_of(KINDS)
        net = _cut(chance) if kind == "cut" else _generated(chance, kind)
    level = chance.one_of(LEVELS)
    mixes = {"cars": 1.0} if kind == "cut" else {"cars": 0.4, "vans": 0.2, "all": 0.4}
    fringe = chance.one_of({"fringe": 0.6, "everywhere": 0.4}) == "fringe"
    demand = DemandDraw(
        junction_per_h=LEVELS[level] * chance.between(0.8, 1.2),
        fringe=fringe,
        shares=MIXES[chance.one_of(mixes)],
        departure=chance.any_of(DEPARTURES),
    )
    return WorldDraw(seed, tuple(chance.features), net, demand)


def check_features(names: Collection[str]) -> None:
    """Refuse unknown features."""
    unknown = sorted(set(names) - FEATURES)
    if unknown:
        known = ", ".join(sorted(FEATURES))
        raise ConfigError(f"--without {unknown[0]}: unknown feature; known: {known}")


class _Chance:
    """Draws random values, and records the drawn features."""

    def __init__(self, seed: int, without: Collection[str]) -> None:
        self._random = np.random.default_rng(seed)
        self._without = without
        self.features: list[str] = []

    def one_of(self, shares: dict[str, float]) -> str:
        """Draw one of the features that are not excluded; their shares are the probabilities."""
        left = {name: share for name, share in shares.items() if name not in self._without}
        if not left:
            raise ConfigError(f"--without: excludes all of {', '.join(shares)}; exclude fewer")
        weights = np.array(list(left.values()))
        chosen = list(left)[self._random.choice(len(left), p=weights / weights.sum())]
        self.features.append(chosen)
        return chosen

    def has(self, feature: str) -> bool:
        """Draw whether a world has a feature of `SHARES`."""
        drawn = bool(self._random.random() < SHARES[feature]) and feature not in self._without
        if drawn:
            self.features.append(feature)
        return drawn

    def any_of(self, choices: Sequence[Drawn]) -> Drawn:
        return choices[int(self._random.integers(len(choices)))]

    def between(self, low: float, high: float) -> float:
        return float(self._random.uniform(low, high))

    def whole(self, low: int, high: int) -> int:
        """Draw an integer from `low` to `high`, both included."""
        return int(self._random.integers(low, high + 1))


def _narrow(seed: int, without: Collection[str]) -> str:
    """Draw a feature of `NARROW`, or "" for the other worlds.

    With separate random numbers, the other worlds are the same as they would be without `NARROW`.
    """
    place = float(np.random.default_rng([seed, 3]).random())
    for name, share in NARROW.items():
        if place < share:
            signals = name == "signal_pair" and "traffic_light" in without
            return "" if name in without or signals else name
        place -= share
    return ""


def _zipper(chance: _Chance) -> NetDraw:
    """Draw a two-way road with zipper merges."""
    limit_mps = chance.any_of(_SPEEDS_MPS)
    length_m = round(chance.between(150.0, 300.0) * max(1.0, limit_mps / 13.89), 1)
    return NetDraw("zipper", (f"--default.speed={limit_mps}",), length_m, chance.whole(2, 4))


def _signal_pair(chance: _Chance) -> NetDraw:
    """Draw pairs of signals on parallel roads; the signals of a pair are 10 to 40 m apart."""
    length_m, num_lanes = round(chance.between(120.0, 220.0), 1), chance.whole(1, 2)
    apart_m = chance.between(10.0, 40.0) + 14.0 + 6.4 * num_lanes
    words = ["--grid=true", f"--grid.x-length={length_m}", f"--grid.y-length={apart_m:.1f}"]
    words += [f"--grid.x-number={chance.whole(1, 3)}", "--grid.y-number=2"]
    words += [f"--grid.attach-length={length_m}", f"--default.lanenumber={num_lanes}"]
    words += ["--default-junction-type=traffic_light", "--no-turnarounds.except-deadend=true"]
    words.append(f"--tls.default-type={chance.one_of(SIGNALS)}")
    chance.features.append("traffic_light")
    return NetDraw("signal_pair", tuple(words), length_m, num_lanes)


def _generated(chance: _Chance, kind: str) -> NetDraw:
    """Draw the options of a net for netgenerate."""
    limit_mps = chance.any_of(_SPEEDS_MPS)
    length_m = round(chance.between(80.0, 220.0) * max(1.0, limit_mps / 13.89), 1)
    words = {
        "grid": lambda: _grid(chance, length_m),
        "spider": lambda: _spider(chance, length_m),
        "random": lambda: _random(chance, length_m),
    }[kind]()
    num_lanes = chance.any_of(_LANES)
    if chance.has("shared_track"):
        num_lanes = 1
        words.append("--default.spreadtype=center")
    words += [f"--default.lanenumber={num_lanes}", f"--default.speed={limit_mps}"]
    words += _junctions(chance)
    if num_lanes > 1 and chance.has("random_lanes"):
        words.append("--random-lanenumber=true")
    if chance.has("turn_lanes"):
        words += ["--turn-lanes=1", f"--turn-lanes.length={chance.between(20.0, 60.0):.0f}"]
    if chance.has("random_priority"):
        words += ["--random-priority=true", "--default.priority=4"]
    if chance.has("perturbed"):
        off_m = chance.between(0.05, 0.2) * length_m
        spread = f"normc(0,{off_m:.1f},{-2.0 * off_m:.1f},{2.0 * off_m:.1f})"
        words += [f"--perturb-x={spread}", f"--perturb-y={spread}"]
    if chance.has("joined"):
        words += ["--junctions.join=true", f"--junctions.join-dist={0.4 * length_m:.0f}"]
    if not chance.has("turnarounds"):
        words.append("--no-turnarounds.except-deadend=true")
    if chance.has("lefthand"):
        words.append("--lefthand=true")
    return NetDraw(kind, tuple(words), length_m, num_lanes)


def _grid(chance: _Chance, length_m: float) -> list[str]:
    words = ["--grid=true", f"--grid.length={length_m}", "--grid.number=" + str(chance.whole(3, 5))]
    if chance.any_of((True, True, False)):
        words.append(f"--grid.attach-length={length_m}")
    return words


def _spider(chance: _Chance, length_m: float) -> list[str]:
    arms, circles = chance.whole(3, 7), chance.whole(2, 4)
    words = ["--spider=true", f"--spider.arm-number={arms}", f"--spider.circle-number={circles}"]
    words.append(f"--spider.space-radius={length_m}")
    if arms > 4 or chance.any_of((True, False)):
        words.append("--spider.omit-center=true")
    if chance.any_of((True, False)):
        words.append(f"--spider.attach-length={length_m}")
    return words


def _random(chance: _Chance, length_m: float) -> list[str]:
    words = ["--rand=true", f"--rand.iterations={chance.whole(20, 70)}"]
    words += [
        f"--rand.min-distance={0.7 * length_m:.1f}",
        f"--rand.max-distance={1.6 * length_m:.1f}",
    ]
    if chance.has("one_way"):
        words.append(f"--bidi-probability={chance.between(0.4, 0.9):.2f}")
    if chance.any_of((True, False, False)):
        words.append("--rand.grid=true")
    return words


def _junctions(chance: _Chance) -> list[str]:
    words = [f"--default-junction-type={chance.one_of(JUNCTIONS)}"]
    if chance.features[-1].startswith("traffic_light"):
        words.append(f"--tls.default-type={chance.one_of(SIGNALS)}")
        words.append(f"--tls.layout={chance.any_of(('opposites', 'opposites', 'incoming'))}")
        words.append(f"--tls.cycle.time={chance.any_of((60, 90))}")
    return words


def _cut(chance: _Chance) -> NetDraw:
    """Draw a piece of a real map, with signals planned by netconvert."""
    words = ["--keep-edges.by-vclass=passenger", "--remove-edges.isolated=true"]
    words += ["--keep-edges.components=1", "--tls.rebuild=true"]
    words.append(f"--tls.default-type={chance.one_of(SIGNALS)}")
    return NetDraw("cut", tuple(words), round(chance.between(200.0, 400.0), 1), 1)
