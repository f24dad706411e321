"""Train a driver, and evaluate it. `train_and_evaluate.ipynb` is the same program as a notebook."""

# %% [markdown]
# # Train a driver, and evaluate it
# `cavmarl train ppo` runs [train/ppo.py](../train/ppo.py). After a million decisions, about a
# minute on one core, the driver has improved visibly.

# %%
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from cavmarl.evaluate import evaluate

SHORT = bool(os.environ.get("CAVMARL_SHORT"))  # a short run for the tests

runs = Path(tempfile.mkdtemp(prefix="cavmarl-")) if SHORT else Path("runs")
few = ["--num-envs", "2", "--num-steps", "16", "--minibatches", "2", "--total-agent-steps", "600"]
size = few if SHORT else ["--total-agent-steps", "1000000", "--imitation-weight", "5"]
command = [
    sys.executable,
    "-m",
    "cavmarl",
    "train",
    "ppo",
    "--env",
    "merge",
    "--runs",
    str(runs),
]
subprocess.run([*command, "--name", "lesson", *size], check=True)
print(sorted(path.name for path in (runs / "lesson").iterdir()))

# %% [markdown]
# The folder of the run has the driver, its learning curve and a manifest. The evaluation compares
# drivers on the same episodes; independent runs give the intervals.

# %%
report = evaluate(
    "merge",
    ["idm", str(runs / "lesson")],
    episodes=1 if SHORT else 8,
    repeats=1 if SHORT else 3,
    max_cycles=20 if SHORT else None,
)
for name, found in report.policies.items():
    shares = {key: found[key].mean for key in ("success", "arrived", "collision", "off_road")}
    print(
        name,
        found.trips,
        {key: None if mean is None else round(mean, 3) for key, mean in shares.items()},
    )
