"""Golden hashes: what worlds do, recorded before a change that must not alter any of it.

    python -m tests.golden.worlds [--write] [--realism] [ROW ...]

compares with worlds.json, or writes it, on the same machine; exit code 1: a row differs.
`--realism` adds the runs of docs/realism.md, minutes of them. A row is a world that is driven for
some steps; the bytes that come out, in a fixed order and without names, make one hash a part.
`WAYS` divide the world, and have to end in the same hashes. Names that may change stand on top.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import sumo
import yaml

import cavmarl
from cavmarl.core.whole_file import write_whole

# Names of cavmarl's that a run needs.
MODES = {"respawn": "respawn", "open": "open", "closed": "closed"}
INFOS = ("mask", "acted", "terms", "arrivals", "episode_over", "vehicle_done", "final_observations")
STATS = ("departed", "waiting", "running", "arrived", "contacts", "mean_speed_mps")
OURS, FIGURES, LOCKS, EDGES = "ours", "figures", "locks_s", "edge_minutes"  # of bench traffic
RECORD = Path(__file__).with_name("worlds.json")
MAPS = os.environ.get("CAVMARL_SHARED_MAPS", Path(__file__).parents[3] / "shared/maps")
GAME = Path(sumo.SUMO_HOME) / "tools" / "game"

DEMAND = """<routes><!-- for grid4x4 and the actuated grid: names of edges begin alike -->
  <vType id="car" sigma="0.4"><param key="has.rerouting.device" value="true"/>
    <param key="device.rerouting.period" value="10"/></vType><vType id="bus" vClass="bus"/>
  <vType id="idm" carFollowModel="IDM" length="4.2"/>
  <vTypeDistribution id="some" vTypes="car idm" probabilities="3 1"/>
  <flow id="a" type="some" from="left0A0" to="A1B1" begin="0" end="60" period="4"/>
  <flow id="b" type="car" from="bottom1B0" to="A1left1" begin="0" end="60" period="exp(0.3)"/>
  <flow id="c" type="idm" from="left1A1" to="B1B0" begin="0" end="60" probability="0.25"
    departLane="free" departPos="random_free" departSpeed="desired"/>
  <vehicle id="bus" type="bus" depart="2"><route edges="left0A0 A0B0"/>
    <stop lane="left0A0_0" endPos="70" duration="5"/></vehicle>
</routes>"""
ACTUATED = """--grid --grid.number 2 --grid.length 120 --grid.attach-length 100 --no-turnarounds
  -L 2 -j traffic_light --tls.default-type actuated -o FOLDER/grid.net.xml"""
WAYS: dict[str, dict[str, Any]] = yaml.safe_load("""{
zones: {zones: 4}, workers: {zones: 4, workers: 2}, sensors: {zones: 2, sensor_workers: 2},
recut: {zones: 4, zones.repartition_steps: 10, zones.repartition_tolerance: 0.0},
nine: {zones: 9, zones.layout: grid, zones.check_invariants: true}}""")  # keywords, and overrides
# Overrides, by the beginning of the key; FOLDER is where demand and actuated grid are.
SETTINGS: dict[str, dict[str, dict[str, Any]]] = yaml.safe_load("""{
fast: {clock: {sim_dt_s: 0.1, ctrl_dt_s: 0.2}}, discrete: {action: {kind: discrete}},
stack: {observation: {kind: dict}, sensors: {stack: 4}},
late: {clock: {control_latency_ticks: 3}, terms: {team_share: 0.4}},
sensors: {sensors: {stack: 3, signal.timing: true, lanes.range_m: 80.0, lidar.rays: 32,
  lidar.speeds: true, lidar_observation.cells: 16,
  kinematics.vehicles_count: 8, kinematics.observe_intentions: true, kinematics.features: [
    presence, x, y, vx, vy, heading, cos_h, sin_h, cos_d, sin_d, long_off, lat_off, ang_off],
  occupancy_grid.features: [presence, vx, vy, heading, long_off, on_road]}},
shuffled: {sensors: {kinematics.vehicles_count: 8, kinematics.order: shuffled,
  kinematics.see_behind: true, kinematics.absolute: true, kinematics.clip: false,
  occupancy_grid.features: [presence, x, y, cos_d], occupancy_grid.align_to_vehicle_axes: true,
  occupancy_grid.as_image: true, lidar_observation.cells: 8, lidar_observation.normalize: false}},
v2x: {v2x: {enabled: true, cam.triggered: true, perception.rate_hz: 5.0, roadside.signals: [all],
  channel.range_m: 250.0, channel.path_loss_exponent: 2.75, channel.latency_ticks: 1,
  channel.loss: 0.1}, sensors: {messages.objects: 6, messages.events: 3, messages.signal: true}},
messages: {observation: {mode: messages}}, sensed: {observation: {mode: sensors, kind: dict}},
rig: {"": {rig: ten_sensors}, map: {buildings: map/buildings.poly.xml}},
demand: {traffic: {demand: [FOLDER/demand.rou.xml]}},
mirrored: {traffic: {source: sumo-traffic}, sensors: {signal.timing: false}},
ordered: {traffic: {source: sumo-demand}, sensors: {signal.timing: false}}}""")


class Row(NamedTuple):
    """A world and who drives in it."""

    env: str
    mode: str  # of MODES; empty: its own
    driver: str = "idm"  # for load_policy, or trembling: that with noise
    steps: int = 60
    ways: str = "zones"  # of WAYS
    settings: str = ""  # of SETTINGS, later ones win
    made: Mapping[str, Any] = {}  # more keywords


BOTH = "zones workers"
FEW, NEXT = {"agents": 12}, {"num_envs": 2, "max_cycles": 15, "autoreset_mode": "NextStep"}
ONE, SOME = {"agents": 1, "background": 20}, {"agents": 3, "background": 40}
ROWS: dict[str, Row] = {
    "two": Row("merge", "respawn", "idm", 200, BOTH, made={"num_envs": 2}),
    "discrete": Row("merge", "closed", "random_actions", 60, "zones", "discrete"),
    "trained": Row("merge", "respawn", "merge_ippo", 100),
    "episodes": Row("merge", "respawn", "trembling", 50, BOTH, "late", NEXT),
    "many": Row("town", "respawn", "trembling", 60, "nine", made={"background": 300}),
    "dicts": Row("grid4x4", "open", "dicts", 0, BOTH, "stack", {"max_cycles": 200}),
    "sumo-traffic": Row("grid4x4", "respawn", "idm", 180, BOTH, "fast demand mirrored", FEW),
    "sumo-demand": Row("grid4x4", "respawn", "idm", 180, BOTH, "fast demand ordered", FEW),
    "demand": Row("grid4x4", "respawn", "idm", 200, BOTH, "fast demand", FEW),
    "actuated": Row("FOLDER/grid.net.xml", "respawn", "idm", 280, "zones", "fast demand", ONE),
    "rig": Row("grid4x4", "respawn", "idm", 20, "zones sensors", "rig", SOME),
    "rig-observed": Row("grid4x4", "respawn", "trembling", 20, "zones", "rig sensed", SOME),
    "v2x": Row("grid4x4", "respawn", "idm", 60, BOTH, "fast v2x", SOME),
    "v2x-messages": Row("town", "respawn", "idm", 60, "zones", "fast v2x messages", SOME),
    "v2x-cacc": Row("merge", "respawn", "cacc", 60, "zones", "fast v2x"),
    "sensors": Row("grid4x4", "open", "trembling", 60, BOTH, "sensors"),
    "shuffled": Row("merge", "respawn", "trembling", 60, BOTH, "shuffled"),
}
for entry in ("ring", "merge", "grid4x4", "town", "rush"):
    ROWS[entry] = Row(entry, "", "idm", 100, BOTH)
    ROWS[f"{entry}-respawn"] = Row(entry, "respawn", "random_actions", 60, "nine", "", FEW)
    ROWS[f"{entry}-open"] = Row(entry, "open", "trembling", 100, "zones recut", "", FEW)
    ROWS[f"{entry}-closed"] = Row(entry, "closed", "trembling", 100, "zones", "", FEW)
for scenario in """pedestrian_crossing unprotected_left_turn intersection_blockage failed_u_turn
        merge_conflict road_closure signal_outage""".split():
    SETTINGS[scenario] = {"scenario": {"name": scenario}, "population": {"budget": None}}
    ROWS[f"scenario-{scenario}"] = Row("grid4x4", "closed", "idm", 150, "zones", scenario, ONE)

REALISM = {  # folder, map and demand for `bench traffic`
    "bologna": "MAPS/net/bologna_acosta acosta_buslanes.net.xml run.sumocfg",
    "mcity": "MAPS/net/mcity mcity.net.xml mcity.rou.xml mcity.add.xml",
    "town10hd-25": "MAPS net/Town10HD.net.xml demand/town10hd_25.rou.xml",
    "town10hd-50": "MAPS net/Town10HD.net.xml demand/town10hd_50.rou.xml",
    "town10hd-100": "MAPS net/Town10HD.net.xml demand/town10hd_100.rou.xml",
    "kuehne": "GAME/kuehne kuehne.net.xml kuehne.rou.xml",
    "cross_demo": "GAME cross/cross.net.xml cross_demo.sumocfg",
    "ramp": "GAME/ramp ramp.net.xml ramp.rou.xml",
}


def batched(row: Row, vec: cavmarl.CavVectorEnv) -> Iterator[tuple[str, Any]]:
    """What comes out of a `make_vec`, by part."""
    worlds, noise = range(vec.num_envs), np.random.default_rng(1)
    policy = cavmarl.load_policy(row.driver.replace("trembling", "idm"), vec)
    observations, infos = vec.reset(seed=11)
    yield "observations", observations
    for step in range(row.steps):
        if "v2x" in row.settings and step % 20 == 5:
            vec.declare_event(0, 1, "obstacle")
        if len(worlds) > 1 and step == row.steps // 2:
            observations, infos = vec.reset(options={"reset_mask": np.array(worlds) == 1})
        actions = policy.act_batch(observations, infos["mask"])
        if row.driver == "trembling":
            actions = (actions + noise.normal(0.0, 0.3, actions.shape)).clip(-1.0, 1.0)
        observations, *ended, infos = vec.step(actions)
        told = [infos[name] for name in INFOS]
        yield from {"observations": observations, "rewards": ended, "infos": told}.items()
        yield "states", [vec.state(), *map(vec.state_hash, worlds)]
        yield "frames", [*vec.frames().values(), *vec.final_frames().values()]
    yield "stats", [[float(vec.traffic_stats(w)[name]) for name in STATS] for w in worlds]


def by_agent(env: cavmarl.CavEnv) -> Iterator[tuple[str, Any]]:
    """What comes out of a `parallel_env`, by part."""
    yield "observations", env.reset(seed=11)[0]
    while env.agents:
        observations, *ended, infos = env.step(env.suggest_actions())
        yield from {"observations": observations, "rewards": ended, "infos": infos}.items()
        yield "states", [env.state(), env.state_hash()]


def drive(row: Row, way: Mapping[str, Any], folder: str) -> dict[str, str]:
    """The hash of each part of what comes out."""
    keywords: dict[str, Any] = {"zones": 1, **row.made}
    overrides: dict[str, Any] = {"population.mode": MODES[row.mode]} if row.mode else {}
    for name in row.settings.split():
        for start, keys in SETTINGS[name].items():
            overrides |= {f"{start}.{key}".strip("."): value for key, value in keys.items()}
    for key, value in way.items():
        (overrides if "." in key else keywords)[key] = value
    overrides = json.loads(json.dumps(overrides).replace("FOLDER", folder))
    make = cavmarl.parallel_env if row.driver == "dicts" else cavmarl.make_vec
    env: Any = make(row.env.replace("FOLDER", folder), overrides=overrides, **keywords)
    found: dict[str, Any] = {}
    try:
        for part, data in by_agent(env) if row.driver == "dicts" else batched(row, env):
            queue = [data]
            while queue:
                item = queue.pop()
                if isinstance(item, Mapping | list | tuple):
                    queue += item.values() if isinstance(item, Mapping) else item
                    continue
                array = np.ascontiguousarray(item)
                kind = f"{array.dtype.str} {array.shape}".encode()
                found.setdefault(part, sha256()).update(kind + array.tobytes())
    finally:
        env.close()
    return {part: hashed.hexdigest()[:32] for part, hashed in found.items()}


def beside_sumo(run: str, path: Path) -> dict[str, Any]:
    """Our figures of one run of `bench traffic`, digit by digit, and a hash of its details."""
    folder, roads, *demand = run.replace("MAPS", str(MAPS)).replace("GAME", str(GAME)).split()
    words = [f"{folder}/{roads}", *(f"--demand={folder}/{name}" for name in demand), "--seed=1"]
    command = [sys.executable, "-m", "cavmarl", "bench", "traffic", *words, f"--json={path}"]
    subprocess.run(command, check=True, capture_output=True)
    ours = json.loads(path.read_text("utf-8"))[OURS]
    figures, *details = (list(ours[part].values()) for part in (FIGURES, LOCKS, EDGES))
    return {"figures": figures, "details": sha256(json.dumps(details).encode()).hexdigest()[:32]}


def write_inputs(folder: str) -> None:
    """Write the demand and the actuated grid that rows name."""
    Path(folder, "demand.rou.xml").write_text(DEMAND, "utf-8")
    command = f"{sumo.SUMO_HOME}/bin/netgenerate {ACTUATED}".replace("FOLDER", folder)
    subprocess.run(command.split(), check=True, capture_output=True)


def run_row(name: str, folder: str) -> dict[str, Any]:
    """The parts of one row; an AssertionError where a way ends in other hashes."""
    if name in REALISM:
        return beside_sumo(REALISM[name], Path(folder, f"{name}.json"))
    found = drive(ROWS[name], {}, folder)
    for way in ROWS[name].ways.split():
        assert drive(ROWS[name], WAYS[way], folder) == found, way
    return found


def main() -> int:
    """Run rows, and compare or write them."""
    every = [*ROWS, *REALISM]
    parser = argparse.ArgumentParser(description=f"Rows: {' '.join(every)}")
    for flag in ("--write", "--realism"):
        parser.add_argument(flag, action="store_true")
    parser.add_argument("rows", nargs="*", metavar="ROW")
    given = parser.parse_args()
    failed = False
    with tempfile.TemporaryDirectory() as folder:
        write_inputs(folder)
        for name in given.rows or (every if given.realism else ROWS):
            said = "written" if given.write else "same"
            try:
                found = run_row(name, folder)
                recorded = json.loads(RECORD.read_text("utf-8")) if RECORD.exists() else {}
                if given.write:
                    rows = json.dumps(recorded | {name: found}, indent=1, sort_keys=True)
                    write_whole(RECORD, f"{rows}\n".encode())
                elif found != (old := recorded.get(name, {})):
                    parts = [part for part in old | found if old.get(part) != found.get(part)]
                    said = f"DIFFERENT: {', '.join(parts)}"
            except Exception as error:
                said = f"DIFFERENT: {type(error).__name__}: {error}"
            failed |= said.startswith("DIFFERENT")
            print(f"{name:32} {said}", flush=True)
            if failed and given.write:
                break
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
