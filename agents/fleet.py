"""The drivers that `population.fleet` names, each for its own agents."""

from __future__ import annotations

from cavmarl.core.errors import PolicyError
from cavmarl.env.parallel import CavEnv
from cavmarl.env.vector import CavVectorEnv
from cavmarl.policies.loading import load_policy
from cavmarl.policies.policy import Policy, SharedPolicy


def make_policy(env: CavEnv | CavVectorEnv) -> Policy:
    """Create the drivers of the fleet.

    Raises:
        PolicyError: there is no fleet, a driver cannot be loaded, or it needs other sensors.
    """
    population = env.config.population
    if not population.fleet:
        raise PolicyError(
            "fleet: this environment has no population.fleet; set it, or name another driver"
        )
    names = list(dict.fromkeys(part.driver for part in population.fleet))
    if "fleet" in names:
        raise PolicyError("population.fleet: a part has the driver 'fleet'; name another driver")
    of_parts = [names.index(part.driver) for part in population.fleet]
    turns = [of_parts[part] for part in population.part_of_agents.tolist()]
    return SharedPolicy(env, [load_policy(name, env) for name in names], turns)
