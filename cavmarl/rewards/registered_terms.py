"""Terms from outside of the package: functions of what is around agents."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from numpy.typing import ArrayLike

from cavmarl.config.terms import TERMS, TermsConfig
from cavmarl.core.errors import ConfigError
from cavmarl.core.extensions import REGISTERED_TERMS
from cavmarl.driving.agent_view import AgentView, BatchView


class RegisteredTerm(NamedTuple):
    """A term from outside."""

    function: Callable[[Any], Any]  # of an `AgentView`, or of a `BatchView`
    reach_m: float
    batched: bool


def register_term(
    name: str,
    function: Callable[[AgentView], float] | Callable[[BatchView], ArrayLike],
    *,
    reach_m: float = 0.0,
    batched: bool = False,
) -> None:
    """Add a term, which `terms.weights` can name like those of the package.

    Args:
        name: of the term.
        function: its number, of an `AgentView` at the end of the step; if `batched`, its numbers
            (n,), of a `BatchView`. It must not depend on the order of `AgentView.others`; that is
            checked when it is first used.
        reach_m: how far away the centres of `AgentView.others` can be; 0: it looks at none.
        batched: whether it answers for all agents of a world at once, and not once an agent.

    Raises:
        ConfigError: the name is taken, or the reach is no distance.
    """
    if not 0.0 <= reach_m < math.inf:
        raise ConfigError(f"term '{name}': reach_m = {reach_m}: must be a distance from 0")
    REGISTERED_TERMS.add(name, RegisteredTerm(function, float(reach_m), batched), function, TERMS)


def terms_reach_m(config: TermsConfig) -> float:
    """How far away the centre of a vehicle can be that changes a registered term, in m."""
    return max((REGISTERED_TERMS[name].reach_m for name in config.registered), default=0.0)
