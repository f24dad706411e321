"""Learning on a GPU; the tests are skipped if torch finds no GPU."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
import torch

from tests.support.training import load_program

PPO = load_program("ppo")
pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU that torch uses")
FEW = "--env merge --num-envs 4 --num-steps 16 --checkpoint-updates 1 --shared".split()


@pytest.mark.parametrize(
    "words", [[], ["--imitation-weight", "1"], ["--keep", "0.35"], ["--residual"]]
)
def test_a_run_on_a_gpu_resumes_on_the_gpu_and_on_the_cpu(tmp_path: Path, words: list[str]) -> None:
    run = tmp_path / "run"
    begun = [*FEW, *words, "--device", "cuda", "--runs", str(tmp_path), "--name", "run"]
    assert PPO.main([*begun, "--total-agent-steps", "200"]) == 0
    for device, steps in (("cuda", 1500), ("cpu", 3000)):
        more = ["--total-agent-steps", str(steps), "--device", device]
        assert PPO.main(["--resume", str(run), *more]) == 0
        rows = list(csv.DictReader((run / "progress.csv").open()))
        assert int(float(rows[-1]["agent_steps"])) >= steps
        assert all(float(row["value_loss"]) > 0.0 for row in rows)
