"""The API of sumo-rl 1.4.5: scripts for sumo-rl only have to change their import.

`from cavmarl.adapters import sumo_rl` replaces `import sumo_rl`; its modules have the same names.
This package simulates the traffic; SUMO does not run. Alegre: "SUMO-RL", 2019.
docs/guides/signal_control.md lists what is supported.
"""

from cavmarl.adapters.sumo_rl.environment.env import SumoEnvironment, env, parallel_env
from cavmarl.adapters.sumo_rl.environment.observations import (
    DefaultObservationFunction,
    ObservationFunction,
)
from cavmarl.adapters.sumo_rl.environment.resco_envs import (
    arterial4x4,
    cologne1,
    cologne3,
    cologne8,
    grid4x4,
    ingolstadt1,
    ingolstadt7,
    ingolstadt21,
)
from cavmarl.adapters.sumo_rl.environment.traffic_signal import TrafficSignal

__all__ = [
    "DefaultObservationFunction",
    "ObservationFunction",
    "SumoEnvironment",
    "TrafficSignal",
    "arterial4x4",
    "cologne1",
    "cologne3",
    "cologne8",
    "env",
    "grid4x4",
    "ingolstadt1",
    "ingolstadt7",
    "ingolstadt21",
    "parallel_env",
]
