"""Checks whether a trained driver was trained on maps of the environment's kind."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

from cavmarl.core.errors import PolicyError
from cavmarl.networks.trained_maps import is_other_side, note_of, untrained_kinds
from cavmarl.policies.other_side import OtherSide
from cavmarl.policies.policy import Environment
from cavmarl.roads.road_kinds import RoadKind


class UntrainedMapWarning(RuntimeWarning):
    """A trained driver drives on a map of a kind that was not part of its training."""


def meet_map(env: Environment, name: str, trained_on: Sequence[RoadKind]) -> OtherSide | None:
    """Warn about kinds of the map that a driver was not trained on.

    Return the exchange of left and right if the driver was trained on the other side; else None.

    Args:
        env: the environment.
        name: name of the driver.
        trained_on: kinds of the maps of its training.

    Raises:
        PolicyError: left and right cannot be exchanged in its observations or actions.
    """
    untrained = untrained_kinds(env.network, trained_on)
    other_side = None
    if is_other_side(untrained):
        try:
            other_side = OtherSide(env.config)
        except PolicyError as error:
            raise PolicyError(f"The policy {name} cannot drive on this map: {error}") from error
    for kind in untrained:
        # The warning names the caller of `load_policy`.
        warnings.warn(note_of(name, kind), UntrainedMapWarning, stacklevel=5)
    return other_side
