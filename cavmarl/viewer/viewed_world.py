"""`Stage`: one of the worlds that pages can choose."""

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
    """A world, its watchers, and the first messages to them.

    Attributes:
        name: name, unique on a server.
        audience: watchers of the world.
        hello: first message to a page, JSON; see `vehicle_details.hello_of`.
        map_bytes: message of the map.
    """

    name: str
    audience: Audience
    hello: dict[str, Any]
    map_bytes: bytes

    @property
    def encoder(self) -> FrameEncoder:
        """Return a new encoder for frames on the stage's map."""
        return FrameEncoder(np.array(unpack(self.map_bytes)[0]["origin"]))

    def named(self, name: str) -> Stage:
        """Return a stage for another world on the same map, with its own watchers."""
        return replace(self, name=name, audience=Audience(self.audience))

    def telling(self, more: dict[str, Any]) -> Stage:
        """Return the same stage with additional data in its first message."""
        return replace(self, hello={**self.hello, **more})


def first_stage(name: str, network: RoadNetwork, hello: dict[str, Any]) -> Stage:
    """Create the stage of a world on a map."""
    return Stage(name, Audience(), hello, map_message(network))


def welcome_of(stages: Sequence[Stage], number: int, control: bool) -> dict[str, Any]:
    """Return the first message to a page that has chosen a stage."""
    names = [stage.name for stage in stages]
    return {**stages[number].hello, "control": control, "worlds": names, "world": number}
