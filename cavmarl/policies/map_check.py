"""Checks whether a trained driver knows maps of the kind that it is to drive on."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

from cavmarl.core.errors import PolicyError
from cavmarl.policies.other_side import OtherSide
from cavmarl.policies.policy import Environment
from cavmarl.roads.road_kinds import RoadKind, road_kinds

_OTHER_SIDE = "left and right are exchanged in its observations and actions"
_WARNINGS: dict[RoadKind, str] = {
    "left_hand": "was trained in right-hand traffic, but this map has left-hand traffic; "
    + _OTHER_SIDE,
    "right_hand": "was trained in left-hand traffic, but this map has right-hand traffic; "
    + _OTHER_SIDE,
    "stop_signs": "was trained on maps without stop signs, but this map has some; its results may "
    "be worse than those on its card",
}


class UntrainedMapWarning(RuntimeWarning):
    """A trained driver drives on a map of a kind that was not part of its training."""


def meet_map(env: Environment, name: str, trained_on: Sequence[RoadKind]) -> OtherSide | None:
    """Warn about kinds of the map that a driver was not trained on.

    Return the exchange of left and right, if the driver was trained on the other side of the road.

    Args:
        env: the environment.
        name: of the driver.
        trained_on: kinds of the maps of its training.

    Raises:
        PolicyError: left and right cannot be exchanged in its observations or actions.
    """
    untrained = [kind for kind in road_kinds(env.network) if kind not in trained_on]
    other_side = None
    if any(kind != "stop_signs" for kind in untrained):
        try:
            other_side = OtherSide(env.config)
        except PolicyError as error:
            raise PolicyError(f"The policy {name} cannot drive on this map: {error}") from error
    for kind in untrained:
        text = f"The policy {name} {_WARNINGS[kind]}"
        warnings.warn(text, UntrainedMapWarning, stacklevel=5)  # the caller of `load_policy`
    return other_side
