"""Multi-agent reinforcement learning for connected and automated vehicles on real road networks.

    import cavmarl
    env = cavmarl.parallel_env("merge", agents=25, background=100, seed=0)  # PettingZoo ParallelEnv
    aec = cavmarl.env("merge")                                              # PettingZoo AEC form
    vec = cavmarl.make_vec("merge", num_envs=16)                            # batched arrays
    policy = cavmarl.load_policy("idm", env)

The import registers the entries of `envs/` with Gymnasium and PettingZoo. The simulator is loaded
at the first use of one of its names.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from cavmarl.config.env import EnvConfig
from cavmarl.config.library_names import register_all
from cavmarl.config.registry import entries
from cavmarl.config.terms import TERMS
from cavmarl.core.errors import (
    ActionError,
    CapacityError,
    CavmarlError,
    ClockError,
    ConfigError,
    DemandError,
    EpisodeError,
    EvaluationError,
    FollowerError,
    FollowerLostError,
    JournalError,
    LostTickError,
    ManifestError,
    MapError,
    MessageError,
    MissingExtraError,
    NoAdmissibleWorkerError,
    PolicyError,
    ProtocolError,
    RecordingError,
    RegisteredFunctionError,
    RouteError,
    ScenarioError,
    ServiceError,
    SumoError,
    TrainingError,
    UnknownArgumentError,
    UnknownEnvironmentError,
    WorkerDeathError,
    WorkerError,
    WorkerFailureError,
    ZoneSimulatorError,
)

if TYPE_CHECKING:
    from cavmarl.driving.agent_view import AgentView, BatchView
    from cavmarl.driving.driver_models import register_driver_model
    from cavmarl.env.parallel import CavEnv, parallel_env
    from cavmarl.env.registration import env, raw_env
    from cavmarl.env.vector import CavVectorEnv, make_vec
    from cavmarl.env.world_arguments import WorldArguments
    from cavmarl.handoff.simulators.simulator_kinds import register_zone_simulator
    from cavmarl.parallel.backends import register_backend
    from cavmarl.policies.loading import load_policy
    from cavmarl.policies.policy import Policy
    from cavmarl.recordings.extra_tables import RecordOptions
    from cavmarl.rewards.registered_terms import register_term
    from cavmarl.sensors.observed.feature import Feature, Sides
    from cavmarl.sensors.registry import register_sensor
    from cavmarl.viewer.live_env import show

__version__ = "0.2.0"

__all__ = [
    "TERMS",
    "ActionError",
    "AgentView",
    "BatchView",
    "CapacityError",
    "CavEnv",
    "CavVectorEnv",
    "CavmarlError",
    "ClockError",
    "ConfigError",
    "DemandError",
    "EnvConfig",
    "EpisodeError",
    "EvaluationError",
    "Feature",
    "FollowerError",
    "FollowerLostError",
    "JournalError",
    "LostTickError",
    "ManifestError",
    "MapError",
    "MessageError",
    "MissingExtraError",
    "NoAdmissibleWorkerError",
    "Policy",
    "PolicyError",
    "ProtocolError",
    "RecordOptions",
    "RecordingError",
    "RegisteredFunctionError",
    "RouteError",
    "ScenarioError",
    "ServiceError",
    "Sides",
    "SumoError",
    "TrainingError",
    "UnknownArgumentError",
    "UnknownEnvironmentError",
    "WorkerDeathError",
    "WorkerError",
    "WorkerFailureError",
    "WorldArguments",
    "ZoneSimulatorError",
    "entries",
    "env",
    "load_policy",
    "make_vec",
    "parallel_env",
    "raw_env",
    "register_backend",
    "register_driver_model",
    "register_sensor",
    "register_term",
    "register_zone_simulator",
    "show",
]

_LATE = {
    "AgentView": "driving.agent_view",
    "BatchView": "driving.agent_view",
    "CavEnv": "env.parallel",
    "CavVectorEnv": "env.vector",
    "Feature": "sensors.observed.feature",
    "Sides": "sensors.observed.feature",
    "Policy": "policies.policy",
    "env": "env.registration",
    "load_policy": "policies.loading",
    "make_vec": "env.vector",
    "parallel_env": "env.parallel",
    "raw_env": "env.registration",
    "RecordOptions": "recordings.extra_tables",
    "WorldArguments": "env.world_arguments",
    "register_backend": "parallel.backends",
    "register_driver_model": "driving.driver_models",
    "register_sensor": "sensors.registry",
    "register_term": "rewards.registered_terms",
    "register_zone_simulator": "handoff.simulators.simulator_kinds",
    "show": "viewer.live_env",
}


def __getattr__(name: str) -> Any:
    if name not in _LATE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(f"{__name__}.{_LATE[name]}"), name)
    if name != "env":
        globals()[name] = found
    return found


def __dir__() -> list[str]:
    return __all__


class _Package(ModuleType):
    """Keeps `cavmarl.env` the function, although the folder of that name is also imported."""

    @property
    def env(self) -> Any:
        return __getattr__("env")

    @env.setter
    def env(self, folder: ModuleType) -> None:
        """Ignore the assignment of the folder, so that it does not hide the function."""

    def __reduce__(self) -> tuple[Any, ...]:
        return import_module, (self.__name__,)


sys.modules[__name__].__class__ = _Package
register_all()
del register_all
