"""`AgentView`: what functions from outside of the package are given of one agent's surroundings.

It is the same however the world is divided: the others are those within a reach that the function
has named, in the order of their ids, with the fields that zones know of each other's vehicles.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import RegisteredFunctionError
from cavmarl.driving.vehicles import GHOST_FIELDS, STATE_FIELDS
from cavmarl.roads.network import RoadNetwork

ORDER_CHECKS = 32  # of each function, the first with two others or more
_OWN = list(STATE_FIELDS)
_OTHERS = list(GHOST_FIELDS)


@dataclass(frozen=True)
class AgentView:
    """An agent's vehicle and the others near it, at the end of a step; all read-only.

    Attributes:
        own: the fields of `VEHICLE` (docs/extending.md) of its vehicle.
        others: (n,) those of the vehicles whose centres are within the reach, by rising id.
        network: the roads; `own["lane"]` is a row of `network.lanes`.
        step_s: seconds a step.
    """

    own: np.void
    others: NDArray[np.void]
    network: RoadNetwork
    step_s: float


def agent_view(
    rows: NDArray[np.void],  # VEHICLE (n,), own ones and ghosts
    i: int,  # of the agent's vehicle
    reach_m: float,  # how far away the centres of others can be
    network: RoadNetwork,
    step_s: float,  # seconds a step
) -> AgentView:
    """The view of row i."""
    dx, dy = rows["x"] - rows["x"][i], rows["y"] - rows["y"][i]
    near = dx * dx + dy * dy <= reach_m * reach_m
    near[i] = False
    found = rows[near]
    others = found[np.argsort(found["id"])][_OTHERS]
    own = rows[i : i + 1].copy()[_OWN]
    others.setflags(write=False)
    own.setflags(write=False)
    return AgentView(own[0], others, network, step_s)


class RegisteredFunction:
    """Calls a function from outside and checks what it answers."""

    def __init__(self, name: str, function: Callable[[AgentView], Any], size: int) -> None:
        self._name = name
        self._function = function
        self._size = size
        self._unchecked = ORDER_CHECKS

    def __call__(self, view: AgentView) -> NDArray[np.float32]:
        """Its numbers (size,)."""
        numbers = self._ask(view)
        if self._unchecked and view.others.size > 1:
            self._unchecked -= 1
            for others in (view.others[::-1], np.roll(view.others, 1)):
                again = self._ask(replace(view, others=others))
                if not np.allclose(numbers, again, rtol=1e-5, atol=1e-6):
                    raise RegisteredFunctionError(
                        f"'{self._name}' depends on the order of view.others, which means nothing: "
                        f"{numbers.tolist()} becomes {again.tolist()} when they change places; "
                        "take the nearest, the least, the sum or the like"
                    )
        return numbers

    def _ask(self, view: AgentView) -> NDArray[np.float32]:
        numbers = np.atleast_1d(np.asarray(self._function(view), dtype=np.float32))
        if numbers.shape != (self._size,) or not np.isfinite(numbers).all():
            raise RegisteredFunctionError(
                f"'{self._name}' of vehicle {view.own['id']} answers {numbers.tolist()}: must be "
                f"{self._size} finite number(s)"
            )
        return numbers
