"""`TermsConfig`: the named terms of a reward and their weights."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from cavmarl.config.checks import Section, Within, check_finite
from cavmarl.config.removed_keys import removed_key
from cavmarl.core.errors import ConfigError
from cavmarl.core.extensions import HOW, REGISTERED_TERMS

# The named terms of a step, in the order of every terms array (`rewards/kernels/terms.py`).
TERMS = (
    "progress",
    "speeding",
    "jerk",
    "ttc_risk",
    "collision",
    "off_road",
    "wrong_way",
    "red_light",
    "arrival",
    "delay",
    "energy",
    "co2",
)


@dataclass(frozen=True)
class TermsConfig(Section, key="terms"):
    """Reward = Σ weight · term; docs/reference/environments.md defines each of `TERMS`.

    Attributes:
        weights: weight of each named term; other terms have weight 0.
        team_share: weight of the mean reward of all live agents: 0 individual, 1 team.
        team_range_m: only agents within this distance count in the mean, as in the local
            coordination of CoPO (Peng et al. 2021); 0: all agents count.
    """

    weights: dict[str, float] = field(
        default_factory=lambda: {
            "progress": 0.1,
            "speeding": -1.0,
            "jerk": -0.01,
            "ttc_risk": -0.1,
            "collision": -10.0,
            "off_road": -10.0,
            "wrong_way": -1.0,
            "red_light": -5.0,
            "arrival": 10.0,
        }
    )
    team_share: Annotated[float, Within(0.0, 1.0)] = 0.0
    team_range_m: Annotated[float, Within(0.0, 1e6)] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, weight in self.weights.items():
            if name not in TERMS and name not in REGISTERED_TERMS:
                raise ConfigError(_unknown_term(name))
            check_finite(f"terms.weights.{name}", weight, -1e6, 1e6)

    @property
    def registered(self) -> tuple[str, ...]:
        """The weighted terms that are not part of the package."""
        return tuple(name for name in self.weights if name not in TERMS)

    @property
    def names(self) -> tuple[str, ...]:
        """All terms of the world, in the order of every terms array."""
        return (*TERMS, *self.registered)

    @property
    def weight_of_each(self) -> tuple[float, ...]:
        """The weights of all terms, in the order of `names`."""
        return tuple(self.weights.get(name, 0.0) for name in self.names)


def _unknown_term(name: str) -> str:
    return removed_key(f"terms.weights.{name}") or (
        f"terms.weights = {name!r}: no such term; must be one of "
        f"{', '.join((*TERMS, *REGISTERED_TERMS))}. If a module registers it with "
        f"cavmarl.register_term, {HOW}"
    )
