"""The scope of the paper on distributed CARLA (A), compared with the results of a short run.

A is cited by its sections and Table 1 (`docs/explanation/papers.md`). Each row is checked for
cavmarl; if a check fails, the exit code is 1.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from benchmarks.clock_drift import measure_drift
from benchmarks.program import run
from cavmarl.balance.load_score import THRESHOLDS, WEIGHTS, Candidate, Utilisation, select
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, silent
from cavmarl.cli.output import Seed, about
from cavmarl.env.vector import make_vec
from cavmarl.v2x.kernels.v2x_records import KIND_CAM, KIND_CPM, KIND_DENM, KIND_SPAT

ENV = "grid4x4"
CROWD: dict[str, Any] = {"agents": 4, "background": 60}
ZONES = 4
NAMES = {KIND_CAM: "CAM", KIND_DENM: "DENM", KIND_CPM: "CPM", KIND_SPAT: "SPAT"}
CAMERA = {"type": "rgb_camera", "rate_hz": 10.0, "width": 320, "height": 180, "z_m": 1.2}
TOLD = {"v2x.enabled": True, "v2x.roadside.signals": ["all"], "v2x.perception.rate_hz": 5.0}


@dataclass(frozen=True)
class Found:
    """The result of a check, and whether the requirement holds."""

    shown: str
    holds: bool


def divided(steps: int, seed: int) -> tuple[Found, Found]:
    """Compare one city over several zones with the undivided world, and count hand-overs."""
    hashes, owners, transfers, once = [], 0, 0, True
    for zones in (1, ZONES):
        with closing(make_vec(ENV, zones=zones, **CROWD)) as vec:
            vec.reset(seed=seed)
            states = []
            for _ in range(steps):
                vec.step(vec.suggest_actions())
                states.append(vec.state_hash())
                ids = vec.world_frames()[0].vehicles["id"]
                once &= len(np.unique(ids)) == len(ids)
                owners = len(ids)
            hashes.append(states)
            transfers = sum(one.switched for one in vec.simulation.coordinators)
    same = sum(one == other for one, other in zip(*hashes, strict=True))
    return (
        Found(
            f"{ZONES} zones: {same} of {steps} steps bit for bit equal to the undivided world",
            same == steps,
        ),
        Found(
            f"{transfers} in {steps} steps; no duplicate or loss among {owners} vehicles",
            transfers > 0 and once and same == steps,
        ),
    )


def placed() -> Found:
    """Check which workers the LoadScore excludes, and which one it chooses."""
    busy = [Candidate(k, Utilisation(*row)) for k, row in enumerate(np.diag(THRESHOLDS) + 1e-6)]
    fleet = [*busy, Candidate(3, Utilisation(0.5, 0.5)), Candidate(4, Utilisation(0.2, 0.1))]
    found = select(fleet)
    out = len(found.rejections)
    return Found(
        f"{out} workers above a threshold excluded; the less loaded of 2 others chosen",
        out == len(THRESHOLDS) and found.worker == 4,
    )


def messages_sent(steps: int, seed: int) -> Found:
    """Count messages by kind."""
    with closing(make_vec(ENV, **CROWD, overrides=TOLD)) as vec:
        vec.reset(seed=seed)
        for step in range(steps):
            if step == 0:
                vec.declare_event(0, 0, "obstacle")
            vec.step(vec.suggest_actions())
        sent = vec.simulation.messages.statistics(0).sent
    counts = {name: int(sent[kind]) for kind, name in NAMES.items()}
    shown = ", ".join(f"{count} {name}" for name, count in counts.items())
    return Found(
        f"{shown} sent in {steps} steps, over a channel without losses, the default",
        min(counts.values()) > 0,
    )


def pictured(seed: int) -> Found:
    """Check a camera's picture."""
    with closing(make_vec(ENV, **CROWD, overrides={"rig": {"front": CAMERA}})) as vec:
        vec.reset(seed=seed)
        vec.step(vec.suggest_actions())
        picture = vec.frames()["front"].data[0, 0, -1]
    colours = len(np.unique(picture.reshape(-1, 3), axis=0))
    return Found(f"shaded shapes, not photorealistic: {colours} colours in a picture", colours > 10)


def clocked(steps: int, seed: int) -> Found:
    """Compare a follower's clock with the master's."""
    found = measure_drift("ring", steps=steps, seed=seed)
    off = max(abs(row.delta_s) for row in found.rows)
    return Found(f"a follower is {off:.1f} s off after {steps} steps", found.holds)


def measure(
    steps: Annotated[int, about("Steps per run.")] = 100,
    seed: Seed = 0,
    say: Say = silent,
) -> BenchmarkReport:
    """Check the scope, row by row."""
    check_range(steps=(steps, 20, 100_000))
    say("zones")
    city, handed_over = divided(steps, seed)
    weights = " / ".join(f"{weight:g}" for weight in WEIGHTS)
    checks: list[tuple[str, str, Callable[[], Found]]] = [
        ("one city over several instances", "CARLA instances, one per zone (3.3)", lambda: city),
        ("hand-over between instances", "acknowledged, then switched (3.7)", lambda: handed_over),
        ("placement by load", f"eq. (1), (2), weights {weights} (3.5)", placed),
        ("one clock for all", "synchronous steps (3.8)", lambda: clocked(steps, seed)),
        ("V2X", "logical interfaces; no network yet (Table 1)", lambda: messages_sent(steps, seed)),
        ("rendering", "photographs, by CARLA (Table 1)", lambda: pictured(seed)),
    ]
    rows = []
    for name, paper, check in checks:
        say(name)
        found = check()
        rows.append({"what": name, "A": paper, "here": found.shown, "holds": found.holds})
    return BenchmarkReport(
        "scope: A compared with a short run",
        {"what": "what", "A": "A", "here": "here", "holds": "holds"},
        rows,
        holds=all(row["holds"] for row in rows),
    )


if __name__ == "__main__":
    run(measure)
