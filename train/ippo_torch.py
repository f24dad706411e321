"""PPO with one network shared by all agents (IPPO), on batched worlds.

    python train/ippo_torch.py --env merge --minutes 2
    python train/ippo_torch.py --config configs/train/merge.yaml
    python train/ippo_torch.py --resume runs/merge_ippo_1 --total-agent-steps 8000000
    python train/ippo_torch.py --env town --workers 2

Every agent learns from its own observations and rewards; all of them share the weights (Schulman et
al. 2017; de Witt et al. 2020). `mappo_torch.py` is the same with a central critic; what both share
is `cavmarl.learning`, where PPO itself stands in `collector.py`, `batch.py` and `learner.py`.

A run's folder holds the driver (`model.safetensors` and `config.json`, which
`cavmarl evaluate --policy FOLDER` takes), `manifest.json` (what it was trained with),
`progress.csv`, TensorBoard's files, and `checkpoint.pt`, from which `--resume` goes on. With the
same seed, threads and machine a run repeats itself for any number of workers, unless the clock ends
it (`--minutes`); so does one that was cut short and goes on. It is never overwritten.
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
    """The critic sees what the agent sees."""

    algorithm: ClassVar[str] = "ippo"


def main(words: Sequence[str] | None = None) -> int:
    """Train; 0: trained, 2: wrong use."""
    return run_program(lambda: train(parse_run(Args, words, __doc__), Console()))


if __name__ == "__main__":
    sys.exit(main())
