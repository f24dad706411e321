"""What functions from outside of the package are given of agents' surroundings.

It is the same however the world is divided: the others are those within a reach that the function
has named, in the order of their ids, with the fields that zones know of each other's vehicles.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
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
        own: the fields of `VEHICLE` (docs/guides/extending.md) of its vehicle.
        others: (n,) those of the vehicles whose centres are within the reach, by rising id.
        network: the roads; `own["lane"]` is a row of `network.lanes`.
        step_s: seconds a step.
    """

    own: np.void
    others: NDArray[np.void]
    network: RoadNetwork
    step_s: float


@dataclass(frozen=True)
class BatchView:
    """Some agents' vehicles and the others near each, at the end of a step; all read-only.

    Which agents are in a batch depends on the division: each answer must be of its agent alone.

    Attributes:
        own: (n,) the fields of `VEHICLE` (docs/guides/extending.md) of their vehicles.
        others: (m,) those of the vehicles near them, agent after agent, each by rising id. One that
            is near two agents is there twice.
        agent: (m,) the row of `own` that each of `others` is near.
        network: the roads; `own["lane"]` are rows of `network.lanes`.
        step_s: seconds a step.
    """

    own: NDArray[np.void]
    others: NDArray[np.void]
    agent: NDArray[np.int64]
    network: RoadNetwork
    step_s: float

    def chosen(self, agents: NDArray[np.int64]) -> BatchView:
        """The view of these agents, in this order."""
        pairs = [np.flatnonzero(self.agent == agent) for agent in agents.tolist()]
        return replace(
            self,
            own=self.own[agents],
            others=self.others[np.concatenate(pairs)],
            agent=np.repeat(np.arange(len(agents)), [len(pair) for pair in pairs]),
        )

    def single(self) -> Iterator[AgentView]:
        """The view of each agent."""
        bounds = np.searchsorted(self.agent, np.arange(len(self.own) + 1))
        for k in range(len(self.own)):
            others = self.others[bounds[k] : bounds[k + 1]]
            yield AgentView(self.own[k], others, self.network, self.step_s)


def batch_view(
    rows: NDArray[np.void],  # VEHICLE (n,), own ones and ghosts
    agents: NDArray[np.int64],  # rows of the agents' vehicles
    reach_m: float,  # how far away the centres of others can be
    network: RoadNetwork,
    step_s: float,  # seconds a step
) -> BatchView:
    """The view of these agents."""
    by_id = np.argsort(rows["id"])
    x, y = rows["x"][by_id], rows["y"][by_id]
    near = [np.zeros(0, np.int64)]
    for i in agents.tolist() if reach_m > 0.0 else ():
        dx, dy = x - rows["x"][i], y - rows["y"][i]
        found = by_id[dx * dx + dy * dy <= reach_m * reach_m]
        near.append(found[found != i])
    counts = [len(found) for found in near[1:]] if reach_m > 0.0 else np.zeros(len(agents), int)
    own = rows[agents][_OWN]
    others = rows[np.concatenate(near)][_OTHERS]
    agent = np.repeat(np.arange(len(agents)), counts)
    for array in (own, others, agent):
        array.setflags(write=False)
    return BatchView(own, others, agent, network, step_s)


class RegisteredFunction:
    """Calls a function from outside for a batch of agents, and checks what it answers.

    Args:
        name: of it.
        function: takes a `BatchView` if it is `batched`, else an `AgentView`.
        size: numbers of an agent.
        batched: whether it answers for all agents at once.
    """

    def __init__(self, name: str, function: Callable[[Any], Any], size: int, batched: bool) -> None:
        self._name = name
        self._function = function
        self._size = size
        self._batched = batched
        self._unchecked = ORDER_CHECKS

    def __call__(self, view: BatchView) -> NDArray[np.float32]:
        """Its numbers (n, size)."""
        numbers = self._ask(view)
        if self._unchecked and np.bincount(view.agent, minlength=1).max() > 1:
            self._unchecked -= 1
            self._check_order(view, numbers)
        return numbers

    def _ask(self, view: BatchView) -> NDArray[np.float32]:
        if self._batched:
            answer = np.asarray(self._function(view), dtype=np.float32)
            answers = answer[:, np.newaxis] if answer.ndim == 1 else answer
            fits = answers.shape == (len(view.own), self._size)
        else:
            each = [
                np.atleast_1d(np.asarray(self._function(one), dtype=np.float32))
                for one in view.single()
            ]
            fits = all(one.shape == (self._size,) for one in each)
            answers = np.stack(each) if fits else each[0]
        if not fits or not np.isfinite(answers).all():
            raise RegisteredFunctionError(
                f"'{self._name}' of vehicles {view.own['id'][:4].tolist()} answers "
                f"{answers[:4].tolist()}: must be {self._size} finite number(s) an agent"
            )
        return answers

    def _check_order(self, view: BatchView, numbers: NDArray[np.float32]) -> None:
        """Ask again with others, and agents, in another order, and for one agent alone."""
        for order in (np.arange(view.agent.size)[::-1], np.roll(np.arange(view.agent.size), 1)):
            moved = order[np.argsort(view.agent[order], kind="stable")]
            again = self._ask(replace(view, others=view.others[moved]))
            self._compare(numbers, again, "view.others, which means nothing", "they change places")
        if self._batched:
            last = np.array([len(view.own) - 1])
            for agents in (np.arange(len(view.own))[::-1], last):
                again = self._ask(view.chosen(agents))
                what = "the other agents of the batch, which depend on the division"
                self._compare(numbers[agents], again, what, "these change")

    def _compare(
        self, numbers: NDArray[np.float32], again: NDArray[np.float32], what: str, when: str
    ) -> None:
        wrong = ~np.isclose(numbers, again, rtol=1e-5, atol=1e-6).all(axis=1)
        if wrong.any():
            before, after = numbers[wrong][0].tolist(), again[wrong][0].tolist()
            raise RegisteredFunctionError(
                f"'{self._name}' depends on the order of {what}: {before} becomes {after} when "
                f"{when}; take the nearest, the least, the sum or the like of each agent's others"
            )
