"""A stand-in for Autoware drives a vehicle with only Autoware's topics and a map folder.

    python -m benchmarks.ros2_driving grid4x4 --episodes 10

The stand-in is `benchmarks/topic_driver.py`, in a process of its own; no Autoware is run. An
episode succeeds if the vehicle arrives without a contact, a red light or leaving the road.
"""

from __future__ import annotations

import json
import subprocess
import time
from collections import Counter
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

from benchmarks import topic_driver
from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, silent
from cavmarl.cli.output import OptionalEnvironment, about, with_world
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import EvaluationError
from cavmarl.core.processes import start_python
from cavmarl.cosim.ros2.bridged_world import BridgedWorld
from cavmarl.cosim.ros2.ros_bridge import RosOptions
from cavmarl.engine.world_frame import events_between
from cavmarl.engine.world_setup import find_map
from cavmarl.env.parallel import parallel_env
from cavmarl.maps.exports.lanelet import write_map_folder
from cavmarl.roads.cache import load_network

AGENT = "car_0"
ENDS_S = 60.0
# Events of the agent's vehicle, the worst first, because a trip can have several events.
OUTCOMES = ("collision", "red_light", "off_road", "wrong_way", "arrived", "out_of_time")


@with_world("background", "seed", "settings")
def measure(
    world: WorldSpec,
    env: OptionalEnvironment = "grid4x4",
    episodes: Annotated[int, about("Number of episodes; each has the next seed.")] = 10,
    step_s: Annotated[float, about("Seconds per step of the world.")] = 0.1,
    domain: Annotated[int, about("ROS_DOMAIN_ID.")] = 91,
    map_folder: Annotated[
        Path | None,
        about("Map folder of Autoware [default: exported from the map].", "--map", exists=True),
    ] = None,
    say: Say = silent,
) -> BenchmarkReport:
    """Drive with only Autoware's topics and a map folder."""
    check_range(episodes=(episodes, 1, 10_000), step_s=(step_s, 0.01, 1.0))
    with TemporaryDirectory() as name:
        if map_folder is None:
            say("exporting the map")
            map_folder = Path(name)
            write_map_folder(load_network(find_map(world.env)), map_folder)
        found = drive_by_topics(
            world, map_folder, episodes=episodes, step_s=step_s, domain=domain, say=say
        )
    counts = Counter(row["outcome"] for row in found["rows"])
    used = found["controls"]
    return BenchmarkReport(
        f"{Path(world.env).name}, stand-in for Autoware, {1000.0 * step_s:g} ms per step",
        {
            "seed": "seed",
            "outcome": "outcome",
            "time, s": "time_s:.1f",
            "distance, m": "distance_m:.0f",
            "events": "events",
        },
        found["rows"],
        notes=[
            f"{counts['arrived']} of {episodes} arrived without an incident; "
            + ", ".join(f"{count} {name}" for name, count in counts.items()),
            f"commands: {used['used']} used, {used['late']} late, {used['invalid']} invalid; "
            f"{found['steps_per_s']:.0f} steps/s of the wall clock",
            "steps by the reason that limited the stand-in's acceleration: "
            + ", ".join(f"{name} {count}" for name, count in found["reasons"].items()),
            "no Autoware was run",
        ],
        facts={"episodes": episodes, "outcomes": dict(counts), **found},
        holds=counts["arrived"] == episodes,
    )


def drive_by_topics(
    spec: WorldSpec,
    folder: Path,
    *,
    episodes: int,
    step_s: float,
    domain: int,
    say: Say = silent,
) -> dict[str, Any]:
    """Run episodes of a world, its bridge, and the stand-in in another process.

    `folder`: a map folder in Autoware's format.

    Returns:
        `rows`: seed, outcome, time and distance of each episode; `controls` and `requests`: counts
        of the bridge; `steps_per_s`; `reasons`: number of steps of the stand-in for each reason of
        its acceleration.

    Raises:
        EvaluationError: the stand-in fails.
        MissingExtraError: the extra `ros2` is not installed.
    """
    overrides = {
        "rig": {"wheels": {"type": "odometry", "rate_hz": 10}},
        "population.mode": "closed",
        "horizon_s": 240.0,
        **spec.overrides,
        "clock.ctrl_dt_s": step_s,
    }
    keywords = {**spec.keywords, "agents": 1, "overrides": overrides}
    options = RosOptions(
        profile="autoware", domain=domain, deadline_s=10.0, ready_s=ENDS_S, truth=True
    )
    rows, steps = [], 0
    words = ["-m", topic_driver.__name__, str(folder), "--domain", str(domain)]
    words += ["--step-s", str(step_s)]
    with closing(parallel_env(spec.env, **keywords)) as env:
        with start_python(words, stdout=subprocess.PIPE, text=True) as process:
            try:
                began_s = time.monotonic()
                with BridgedWorld(env, [AGENT], options) as bridged:
                    for episode in range(episodes):
                        seed = spec.seed + episode
                        rows.append(_episode(bridged, seed))
                        steps += rows[-1]["steps"]
                        say(f"seed {seed}: {rows[-1]['outcome']}")
                wall_s = time.monotonic() - began_s
                output, _ = process.communicate(timeout=ENDS_S)
            finally:
                process.kill()
        if process.returncode:
            raise EvaluationError(f"the stand-in has ended with {process.returncode}")
    return {
        "rows": rows,
        "controls": bridged.report["controls"][AGENT],
        "requests": bridged.report["requests"][AGENT],
        "steps_per_s": steps / wall_s,
        "reasons": json.loads(output),
    }


def _episode(bridged: BridgedWorld, seed: int) -> dict[str, Any]:
    world, env = bridged.world, bridged.world.env
    world.reset(seed)
    before = env.world_frames([0])[0]
    events: Counter[str] = Counter()
    steps, distance_m = 0, 0.0
    while not world.is_over:
        own = before.vehicles[before.vehicles["agent"] == 0]
        distance_m = float(own["distance_m"][0]) if len(own) else distance_m
        world.step()
        after = env.world_frames([0])[0]
        steps += 1
        events.update(event.kind for event in events_between(before, after) if event.agent == 0)
        before = after
    outcome = next((name for name in OUTCOMES if events[name]), "out_of_time")
    return {
        "seed": seed,
        "outcome": outcome,
        "steps": steps,
        "time_s": steps * env.config.clock.ctrl_dt_s,
        "distance_m": distance_m,
        "events": ", ".join(f"{count} {name}" for name, count in events.items()),
    }


if __name__ == "__main__":
    run(measure)
