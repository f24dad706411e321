"""Makes the parts that act beside the traffic, as an environment asks for them."""

from __future__ import annotations

from cavmarl.engine.component import Attached, ComponentContext
from cavmarl.engine.rig_component import MountedSensors
from cavmarl.engine.scenario_cues import Cues
from cavmarl.engine.v2x_component import Messaging


def attach(host: ComponentContext) -> tuple[Attached, ...]:
    """The parts that the environment asks for, in the order in which they act."""
    parts: list[Attached] = []
    if host.config.scenario.name:
        parts.append(Cues(host.travel.scripts.cues, host.shards, host.division))
    if host.config.rig:
        parts.append(MountedSensors(host))
    if host.config.v2x.enabled:
        parts.append(Messaging(host))
    return tuple(parts)
