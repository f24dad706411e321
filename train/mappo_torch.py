"""PPO with one network shared by all agents and a central critic (MAPPO), on batched worlds.

    python train/mappo_torch.py --env merge --minutes 2
    python train/mappo_torch.py --config configs/train/merge.yaml --workers 2

While it learns, the critic sees the state of the whole world (`vec.state()`) beside what the agent
itself observes (Yu et al. 2022); the driver never does, so it drives wherever one of
`ippo_torch.py` does. Options, files and what repeats itself are the same as there.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from rich.console import Console

from cavmarl.learning.options import run_program
from cavmarl.learning.ppo_settings import PpoSettings
from cavmarl.learning.run import train
from cavmarl.learning.run_folder import parse_run


@dataclass(frozen=True)
class Args(PpoSettings):
    """The critic sees the whole world."""

    program: ClassVar[str] = "mappo_torch.py"
    algorithm: ClassVar[str] = "mappo"
    central_critic: ClassVar[bool] = True


def main(words: Sequence[str] | None = None) -> int:
    """Train; 0: trained, 2: wrong use."""
    return run_program(lambda: train(parse_run(Args, words, __doc__), Console()))


if __name__ == "__main__":
    sys.exit(main())
