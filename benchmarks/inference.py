"""Inference of driver networks: the kernel compared with torch, in turn, on one core.

All weights and observations are random. Both sides evaluate the same rows; torch uses
`inference_mode` and one thread.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.program import run
from cavmarl.bench.harness import (
    BenchmarkReport,
    Say,
    check_positive,
    check_range,
    one_core,
    paired_ratio,
    silent,
    take_turns,
)
from cavmarl.cli.output import about
from cavmarl.config.action import ActionConfig
from cavmarl.config.sensors import SensorsConfig
from cavmarl.core.errors import require
from cavmarl.networks.driver_network import DriverNetwork
from cavmarl.networks.network_files import MAX_OBSERVATION_SIZE, MAX_WIDTH, NetworkConfig

FORMS = {"tanh": False, "LayerNorm, ReLU": True}  # kind of layers: value of `shared`

Pass = Callable[[], NDArray[np.float32]]


def measure(
    rows: Annotated[int, about("Observations per call.")] = 1600,
    inputs: Annotated[int, about("Numbers per observation.")] = 105,
    hidden: Annotated[int, about("Width of each of the two hidden layers.")] = 128,
    repeats: Annotated[int, about("Number of turns.")] = 40,
    most_ratio: Annotated[float | None, about("Exit with 1 if the ratio is above this.")] = None,
    say: Say = silent,
) -> BenchmarkReport:
    """Time a driver's forward pass by the kernel that evaluates drivers, and by torch."""
    check_range(rows=(rows, 1, 1_000_000), inputs=(inputs, 1, MAX_OBSERVATION_SIZE))
    check_range(hidden=(hidden, 1, MAX_WIDTH), repeats=(repeats, 1, 100_000))
    check_positive("--most-ratio", most_ratio)
    torch = require("torch", "train")
    threads = torch.get_num_threads()
    found: list[dict[str, Any]] = []
    with one_core():
        torch.set_num_threads(1)
        try:
            for name, is_shared in FORMS.items():
                config = NetworkConfig(
                    "merge",
                    inputs,
                    SensorsConfig(),
                    ActionConfig(),
                    hidden=(hidden, hidden),
                    shared=is_shared,
                )
                found.append({"form": name} | _compare(config, rows, repeats, say))
        finally:
            torch.set_num_threads(threads)
    return BenchmarkReport(
        title=f"{rows} rows, widths {inputs}, {hidden}, {hidden}, 2, one core: ns per row",
        columns={"layers": "form", "kernel": "kernel_ns:,.0f", "torch": "torch_ns:,.0f"}
        | {"ratio": "ratio:.2f", "largest difference": "difference:.1e"},
        rows=found,
        notes=[f"Medians of {repeats} turns; the ratio is the median over the turns."],
        facts={"rows_per_call": rows, "inputs": inputs, "hidden": hidden},
        holds=most_ratio is None or all(row["ratio"] <= most_ratio for row in found),
    )


def _compare(config: NetworkConfig, rows: int, repeats: int, say: Say) -> dict[str, Any]:
    """Time both sides in turn."""
    ours, theirs = _sides(config, rows)
    difference = float(np.abs(ours() - theirs()).max())
    taken = take_turns({"ours": _timed(ours), "theirs": _timed(theirs)}, repeats, say)
    ones, others = taken["ours"], taken["theirs"]
    return {
        "kernel_ns": 1e9 * median(ones) / rows,
        "torch_ns": 1e9 * median(others) / rows,
        "ratio": paired_ratio(ones, others),
        "difference": difference,
    }


def _sides(config: NetworkConfig, rows: int) -> tuple[Pass, Pass]:
    """Return functions that evaluate one network on the same observations: kernel, torch."""
    import torch

    from cavmarl.learning.actor_critic import ActorCritic

    torch.manual_seed(0)
    learned = ActorCritic(config)
    weights = {name: tensor.detach().numpy() for name, tensor in learned.state_dict().items()}
    network = DriverNetwork(weights, config)
    observations = np.random.default_rng(0).normal(size=(rows, config.observation_size))
    given = observations.astype(np.float32)
    known = torch.from_numpy(given)

    def theirs() -> NDArray[np.float32]:
        with torch.inference_mode():
            best: NDArray[np.float32] = learned.best(known).numpy()
        return best

    return lambda: network.best(given), theirs


def _timed(act: Pass) -> Callable[[], float]:
    def seconds() -> float:
        begin = time.perf_counter()
        act()
        return time.perf_counter() - begin

    return seconds


if __name__ == "__main__":
    run(measure)
