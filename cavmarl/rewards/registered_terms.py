"""Terms registered by users: functions of an agent's surroundings."""

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
    """A term registered by a user."""

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
    """Register a term; `terms.weights` can then name it like the package's terms.

    Args:
        name: name of the term.
        function: returns the value for an `AgentView` at the end of the step; if `batched`, the
            values (n,) for a `BatchView`. It must not depend on the order of `AgentView.others`;
            this is checked at its first use.
        reach_m: maximum distance from the agent's centre to those of `AgentView.others`; 0: none.
        batched: whether the function is called once for all agents of a world.

    Raises:
        ConfigError: the name is taken, or the reach is invalid.
    """
    if not 0.0 <= reach_m < math.inf:
        raise ConfigError(f"term '{name}': reach_m = {reach_m}: must be at least 0 and finite")
    REGISTERED_TERMS.add(name, RegisteredTerm(function, float(reach_m), batched), function, TERMS)


def terms_reach_m(config: TermsConfig) -> float:
    """Return the largest distance in m at which a vehicle can affect a registered term."""
    return max((REGISTERED_TERMS[name].reach_m for name in config.registered), default=0.0)
