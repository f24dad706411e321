"""The view of an agent's surroundings that registered functions receive.

The view does not depend on the division of the world: it contains the vehicles within the reach
that the function declares, ordered by id, with the fields that zones share about their vehicles.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import RegisteredFunctionError
from cavmarl.driving.vehicles import GHOST_FIELDS, STATE_FIELDS
from cavmarl.roads.network import RoadNetwork

ORDER_CHECKS = 32  # number of views per function for which `_check_order` runs
_OWN = list(STATE_FIELDS)
_OTHERS = list(GHOST_FIELDS)


@dataclass(frozen=True)
class AgentView:
    """An agent's vehicle and the vehicles near it, at the end of a step; read-only.

    Attributes:
        own: the fields of `VEHICLE` (docs/guides/extending.md) of the agent's vehicle.
        others: (n,) the same fields of vehicles whose centres are in reach, by increasing id.
        network: the roads; `own["lane"]` is a row of `network.lanes`.
        step_s: length of a step in s.
    """

    own: np.void
    others: NDArray[np.void]
    network: RoadNetwork
    step_s: float


@dataclass(frozen=True)
class BatchView:
    """The vehicles of several agents and the vehicles near them, at the end of a step; read-only.

    The agents in a batch depend on the division of the world, so the result for an agent must not
    depend on the other agents.

    Attributes:
        own: (n,) the fields of `VEHICLE` (docs/guides/extending.md) of the agents' vehicles.
        others: (m,) the same fields of vehicles near each agent, agent by agent, by increasing id.
            A vehicle near two agents occurs twice.
        agent: (m,) for each vehicle of `others`, the row of the agent in `own`.
        network: the roads; `own["lane"]` are rows of `network.lanes`.
        step_s: length of a step in s.
    """

    own: NDArray[np.void]
    others: NDArray[np.void]
    agent: NDArray[np.int64]
    network: RoadNetwork
    step_s: float

    def chosen(self, agents: NDArray[np.int64]) -> BatchView:
        """Return a view that contains only these rows of `own`, in this order."""
        pairs = [np.flatnonzero(self.agent == agent) for agent in agents.tolist()]
        return replace(
            self,
            own=self.own[agents],
            others=self.others[np.concatenate(pairs)],
            agent=np.repeat(np.arange(len(agents)), [len(pair) for pair in pairs]),
        )

    def single(self) -> Iterator[AgentView]:
        """Yield one `AgentView` per agent."""
        bounds = np.searchsorted(self.agent, np.arange(len(self.own) + 1))
        for k in range(len(self.own)):
            others = self.others[bounds[k] : bounds[k + 1]]
            yield AgentView(self.own[k], others, self.network, self.step_s)


def batch_view(
    rows: NDArray[np.void],  # VEHICLE (n,), owned rows and ghosts
    agents: NDArray[np.int64],  # rows of the agents' vehicles
    reach_m: float,  # largest distance between the centres of the agent and of other vehicles
    network: RoadNetwork,
    step_s: float,  # length of a step, s
) -> BatchView:
    """Return the view of these agents."""
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
    """A registered function, with checks of the values that it returns.

    Args:
        name: the name of the function.
        function: takes a `BatchView` if `batched`, else an `AgentView`.
        size: number of values per agent.
        batched: whether the function returns the values of all agents at once.
    """

    def __init__(self, name: str, function: Callable[[Any], Any], size: int, batched: bool) -> None:
        self._name = name
        self._function = function
        self._size = size
        self._batched = batched
        self._unchecked = ORDER_CHECKS

    def __call__(self, view: BatchView) -> NDArray[np.float32]:
        """Return the function's values (n, size).

        Raises:
            RegisteredFunctionError: the values have another shape, are not finite, or depend on
                the order of other vehicles or on other agents.
        """
        numbers = self._ask(view)
        if self._unchecked and np.bincount(view.agent, minlength=1).max() > 1:
            self._unchecked -= 1
            self._check_order(view, numbers)
        return numbers

    def _ask(self, view: BatchView) -> NDArray[np.float32]:
        if self._batched:
            answer = self._numbers(self._function(view))
            answers = answer[:, np.newaxis] if answer.ndim == 1 else answer
            fits = answers.shape == (len(view.own), self._size)
        else:
            each = [np.atleast_1d(self._numbers(self._function(one))) for one in view.single()]
            odd = [one for one in each if one.shape != (self._size,)]
            fits, answers = not odd, odd[0] if odd else np.stack(each)
        if not fits:
            self._refuse(f"{answers.tolist()!r:.200}")
        wrong = np.argwhere(~np.isfinite(answers))
        if len(wrong):
            agent, place = wrong[0].tolist()
            own = view.own[agent]
            which = f" as number {place}" if self._size > 1 else ""
            self._refuse(
                f"{answers[agent, place]}{which} for agent {own['agent']} (vehicle {own['id']})"
            )
        return answers

    def _refuse(self, what: str) -> NoReturn:
        raise RegisteredFunctionError(
            f"registered function '{self._name}' returned {what}; it must return {self._size} "
            "finite number(s) per agent"
        )

    def _numbers(self, answer: Any) -> NDArray[np.float32]:
        """Return an answer as an array; raise RegisteredFunctionError if it has no numbers."""
        try:
            found = np.asarray(answer)
            if found.dtype.kind in "biuf":
                return found.astype(np.float32)
        except (TypeError, ValueError):  # rows of different lengths, for example
            pass
        self._refuse(f"{answer!r:.200}")

    def _check_order(self, view: BatchView, numbers: NDArray[np.float32]) -> None:
        """Check that values do not depend on the order of vehicles or on other agents."""
        for order in (np.arange(view.agent.size)[::-1], np.roll(np.arange(view.agent.size), 1)):
            moved = order[np.argsort(view.agent[order], kind="stable")]
            again = self._ask(replace(view, others=view.others[moved]))
            self._compare(numbers, again, "the order of view.others")
        if self._batched:
            last = np.array([len(view.own) - 1])
            for agents in (np.arange(len(view.own))[::-1], last):
                again = self._ask(view.chosen(agents))
                self._compare(numbers[agents], again, "the other agents of the batch")

    def _compare(
        self, numbers: NDArray[np.float32], again: NDArray[np.float32], changed: str
    ) -> None:
        wrong = ~np.isclose(numbers, again, rtol=1e-5, atol=1e-6).all(axis=1)
        if wrong.any():
            before, after = numbers[wrong][0].tolist(), again[wrong][0].tolist()
            raise RegisteredFunctionError(
                f"registered function '{self._name}' depends on {changed}: it returned {before} "
                f"before and {after} after a change; return values that do not depend on it, such "
                "as the nearest, the minimum or the sum over each agent's others"
            )
