"""Multi-agent reinforcement learning for connected and automated vehicles on real road networks.

    import cavmarl
    env = cavmarl.parallel_env("merge", agents=25, background=100, seed=0)  # PettingZoo ParallelEnv
    aec = cavmarl.env("merge")                                              # PettingZoo AEC form
    vec = cavmarl.make_vec("merge", num_envs=16)                            # batched arrays
    policy = cavmarl.load_policy("idm", env)

Importing it registers the entries of `envs/` with Gymnasium and PettingZoo.
"""

from cavmarl.config.env import TERMS, EnvConfig
from cavmarl.config.registry import entries
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
    UnknownEnvironmentError,
    WorkerDeathError,
    WorkerError,
    WorkerFailureError,
)
from cavmarl.driving.agent_view import AgentView, BatchView
from cavmarl.driving.driver_models import register_driver_model
from cavmarl.env.parallel import CavEnv, parallel_env
from cavmarl.env.registration import env, raw_env, register_all
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.parallel.backends import register_backend
from cavmarl.policies.policy import Policy, load_policy
from cavmarl.rewards.registered_terms import register_term
from cavmarl.sensors.observed.feature import Feature
from cavmarl.sensors.registry import register_sensor

__version__ = "0.1.0"

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
    "RecordingError",
    "RegisteredFunctionError",
    "RouteError",
    "ScenarioError",
    "ServiceError",
    "SumoError",
    "TrainingError",
    "UnknownEnvironmentError",
    "WorkerDeathError",
    "WorkerError",
    "WorkerFailureError",
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
]

register_all()
del register_all
