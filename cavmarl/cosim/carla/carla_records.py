"""Records about actors, as they are sent."""

from __future__ import annotations

from typing import Any

from cavmarl.cosim.carla.carla_actors import CarlaActor
from cavmarl.cosim.carla.carla_blueprints import BLUEPRINTS
from cavmarl.cosim.carla.carla_versions import ClientVersion

_STRING = "string"
_KINDS = ("bool", "int", "float", "string", "colour")


def packed_box(actor: CarlaActor | None, version: ClientVersion) -> list[Any]:
    """Return the bounding box of an actor; zeros for None."""
    zero = [0.0, 0.0, 0.0]
    box = [zero, zero] if actor is None else [list(actor.centre), list(actor.half_m)]
    number = [] if not version.box_has_actor else [0 if actor is None else actor.number]
    return [*box, zero, *number]


def packed_actor(actor: CarlaActor, version: ClientVersion) -> list[Any]:
    blueprint = BLUEPRINTS.get(actor.type_id)
    kinds = {} if blueprint is None else {one.name: one.kind for one in blueprint.attributes}
    attributes = [
        [name, version.first_attribute_kind + _KINDS.index(kinds.get(name, _STRING)), value]
        for name, value in actor.attributes.items()
    ]
    return [
        actor.number,
        actor.parent,
        [actor.number, actor.type_id, attributes],
        packed_box(actor, version),
        actor.tags,
        actor.token,
    ]
