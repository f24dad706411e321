"""A `Scene`: the actors, their scripts and the agent's start. Scenarios make them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from cavmarl.traffic.scenarios.movement_scripts import Actor, Cue


@dataclass(frozen=True)
class Seat:
    """Where the agent's vehicle begins."""

    lane: int
    s: float  # of its centre on the lane, m
    speed_mps: float  # at the beginning, and what its built-in driver would like to keep
    goal_edge: int  # EDGE row where its trip ends


class Outage(NamedTuple):
    """A signal that goes dark: the name of the signal, and when, in s since the beginning."""

    signal: str
    at_s: float


@dataclass(frozen=True)
class Scene:
    """One conflict, played to an agent; others may come behind it (`seats`)."""

    place: str  # where, by the map's name
    x: float  # its middle, m
    y: float
    seat: Seat
    actors: Sequence[Actor]  # those that follow a script
    cues: Sequence[Cue] = ()  # what they wait for, by the numbers of their `Await`s
    clear_m: float = 90.0  # how far around the middle no other vehicle is in the beginning
    outages: Sequence[Outage] = ()  # signals that go dark, and stay so

    @property
    def goal_edges(self) -> list[int]:
        released = [a.released_to for a in self.actors if a.released_to is not None]
        return list(dict.fromkeys([self.seat.goal_edge, *released]))
