"""`Stage`: one world as pages can choose it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cavmarl.roads.network import RoadNetwork
from cavmarl.viewer.frame_messages import FrameEncoder
from cavmarl.viewer.map_geometry import map_message, unpack
from cavmarl.viewer.subscribers import Audience


@dataclass(frozen=True)
class Stage:
    """A world, its watchers, and what they are told first.

    Attributes:
        name: among those of one server.
        audience: its watchers.
        hello: what a page is told first, JSON; see `vehicle_details.hello_of`.
        map_bytes: the map's message.
    """

    name: str
    audience: Audience
    hello: dict[str, Any]
    map_bytes: bytes

    @property
    def encoder(self) -> FrameEncoder:
        """A new one, of frames on its map."""
        return FrameEncoder(np.array(unpack(self.map_bytes)[0]["origin"]))

    def named(self, name: str) -> Stage:
        """Another world on the same map, with watchers of its own."""
        return replace(self, name=name, audience=Audience(self.audience))

    def telling(self, more: dict[str, Any]) -> Stage:
        """The same, of which pages are told more."""
        return replace(self, hello={**self.hello, **more})


def first_stage(name: str, network: RoadNetwork, hello: dict[str, Any]) -> Stage:
    """The stage of a world on a map."""
    return Stage(name, Audience(), hello, map_message(network))


def welcome_of(stages: Sequence[Stage], number: int, control: bool) -> dict[str, Any]:
    """The first message to a page that has chosen a stage."""
    names = [stage.name for stage in stages]
    return {**stages[number].hello, "control": control, "worlds": names, "world": number}
