"""`PpoSettings`: the settings of a run of PPO on batched worlds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from cavmarl.learning.options import (
    RESUME,
    check_above_zero,
    check_at_least,
    check_shares,
    run_folder,
)


@dataclass(frozen=True)
class PpoSettings:
    """The settings of a run; each is an option of the command line.

    What tells the algorithms apart are no settings: how they are called, and whether the critic
    sees the state of the whole world.
    """

    program: ClassVar[str] = "ippo_torch.py"
    algorithm: ClassVar[str] = "ippo"
    central_critic: ClassVar[bool] = False

    env: Annotated[str, "environment: a name, a folder or a map file"] = "merge"
    agents: Annotated[int, "agents a world; 0: as the environment says"] = 0
    background: Annotated[int, "background vehicles a world; -1: as the environment says"] = -1
    num_envs: Annotated[int, "worlds that are stepped together"] = 16
    zones: Annotated[int, "zones a world; 0: as the environment says"] = 0
    workers: Annotated[int, "processes that the worlds are shared out over; 0: this one"] = 0
    overlap: Annotated[bool, "collect while learning, with the network of one update before"] = (
        False
    )
    seed: Annotated[int, "root of all random numbers"] = 0
    total_agent_steps: Annotated[int, "decisions to learn from"] = 4_000_000
    minutes: Annotated[float, "stop after this time, whatever is left; 0: no limit"] = 0.0
    num_steps: Annotated[int, "steps of every world between two updates"] = 128
    epochs: Annotated[int, "passes over the decisions of an update"] = 4
    minibatches: Annotated[int, "parts that a pass is cut into"] = 8
    learning_rate: Annotated[float, "of Adam, at the start"] = 1e-3
    anneal: Annotated[bool, "let the learning rate fall to 0 at the end"] = True
    gamma: Annotated[float, "discount a step"] = 0.99
    gae_lambda: Annotated[float, "of generalised advantage estimation"] = 0.95
    clip: Annotated[float, "how far the ratio of probabilities may leave 1"] = 0.2
    entropy_weight: Annotated[float, "of the entropy in the loss"] = 0.0
    value_weight: Annotated[float, "of the value loss"] = 0.5
    imitation_weight: Annotated[float, "of the distance to the built-in driver, at the start"] = 0.0
    imitation_share: Annotated[float, "share of the run in which that weight falls to 0"] = 0.1
    max_gradient_norm: Annotated[float, "longer gradients are shortened"] = 0.5
    throttle_std: Annotated[float, "standard deviation of the throttle at the start"] = 0.3
    steering_std: Annotated[float, "standard deviation of the steering at the start"] = 0.1
    hidden: Annotated[int, "width of the two hidden layers"] = 128
    threads: Annotated[int, "of torch; more cost small networks more than they bring"] = 1
    checkpoint_updates: Annotated[int, "updates between two checkpoints"] = 20
    runs: Annotated[str, "folder of all runs"] = "runs"
    name: Annotated[str, "folder of this run; empty: ENV_ALGORITHM_SEED"] = ""
    resume: Annotated[str, RESUME] = ""
    tensorboard: Annotated[bool, "write TensorBoard's files"] = False

    def __post_init__(self) -> None:
        at_least = {
            "agents": 0, "background": -1, "num_envs": 1, "zones": 0, "workers": 0, "seed": 0,
            "total_agent_steps": 1, "minutes": 0.0, "num_steps": 1, "epochs": 1, "minibatches": 1,
            "entropy_weight": 0.0, "value_weight": 0.0, "imitation_weight": 0.0, "hidden": 1,
            "threads": 1, "checkpoint_updates": 1,
        }  # fmt: skip
        above_zero = (
            "learning_rate", "clip", "max_gradient_norm", "throttle_std", "steering_std",
            "imitation_share",
        )  # fmt: skip
        check_at_least(self, at_least)
        check_above_zero(self, above_zero)
        check_shares(self, ("gamma", "gae_lambda"))

    @property
    def folder(self) -> Path:
        name = (self.name, self.env, self.algorithm, self.seed)
        return run_folder(self.runs, *name, resume=self.resume)
