"""Golden hashes of eight worlds, recorded before a change that must not alter their results.

    python -m tests.golden.worlds [ROW ...]

This command writes `worlds.json`, and `test_golden.py` compares results with this file. A row is a
world that a driver drives for some steps. The results of a row have several parts; each part has
one hash, of its arrays in a fixed order, without their names. `WAYS` are divisions of a world,
which must have the same hashes. The names of cavmarl that a run uses are constants at the top,
because a change may rename them.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

import cavmarl
from cavmarl.core.atomic_file import write_whole

# Names of cavmarl that a run needs.
INFOS = ("mask", "acted", "terms", "arrivals", "episode_over", "vehicle_done", "final_observations")
STATS = ("departed", "waiting", "running", "arrived", "contacts", "mean_speed_mps")
RECORD = Path(__file__).with_name("worlds.json")

DEMAND = """<routes><!-- for grid4x4 -->
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
# Keywords of `make_vec`.
WAYS: dict[str, dict[str, Any]] = {
    "zones": {"zones": 4},
    "workers": {"zones": 4, "workers": 2},
    "sensors": {"zones": 2, "sensor_workers": 2},
}
# Overrides, grouped by the first part of the key; FOLDER stands for the folder of the demand.
SETTINGS: dict[str, dict[str, dict[str, Any]]] = yaml.safe_load("""{
respawn: {population: {mode: respawn}},
fast: {clock: {sim_dt_s: 0.1, ctrl_dt_s: 0.2}},
v2x: {v2x: {enabled: true, cam.triggered: true, perception.rate_hz: 5.0, roadside.signals: [all],
  channel.range_m: 250.0, channel.path_loss_exponent: 2.75, channel.latency_ticks: 1,
  channel.loss: 0.1}, sensors: {messages.objects: 6, messages.events: 3, messages.signal: true}},
rig: {"": {rig: ten_sensors}, map: {buildings: map/buildings.poly.xml}},
demand: {traffic: {demand: [FOLDER/demand.rou.xml]}},
mirrored: {traffic: {source: sumo-traffic}, sensors: {signal.timing: false}}}""")


class Row(NamedTuple):
    """A world and its driver."""

    env: str
    settings: str  # names in SETTINGS; later settings override earlier ones
    steps: int
    ways: str = "zones workers"  # names in WAYS
    driver: str = "idm"  # driver, as for `load_policy`
    made: Mapping[str, Any] = {}  # further keywords of `make_vec`


SOME, FEW = {"agents": 3, "background": 40}, {"agents": 12}
ROWS: dict[str, Row] = {
    "two": Row("merge", "respawn", 200, made={"num_envs": 2}),
    "merge": Row("merge", "", 100),
    "town": Row("town", "", 100),
    "demand": Row("grid4x4", "respawn fast demand", 200, made=FEW),
    "rig": Row("grid4x4", "respawn rig", 20, "zones sensors", made=SOME),
    "v2x": Row("grid4x4", "respawn fast v2x", 60, made=SOME),
    "sumo-traffic": Row("grid4x4", "respawn fast demand mirrored", 180, "zones", made=FEW),
    # Kernels evaluate the network of a driver, so its results are the same on every processor, too.
    "trained": Row("merge", "respawn", 100, "zones", "merge_ippo"),
}


def _parts(row: Row, vec: cavmarl.CavVectorEnv) -> Iterator[tuple[str, Any]]:
    """Drive a world; yield each array of results with the name of its part."""
    worlds = range(vec.num_envs)
    policy = cavmarl.load_policy(row.driver, vec)
    observations, infos = vec.reset(seed=11)
    yield "observations", observations
    for step in range(row.steps):
        if "v2x" in row.settings and step % 20 == 5:
            vec.declare_event(0, 1, "obstacle")
        if len(worlds) > 1 and step == row.steps // 2:
            observations, infos = vec.reset(options={"reset_mask": np.array(worlds) == 1})
        actions = policy.act_batch(observations, infos["mask"])
        observations, *ended, infos = vec.step(actions)
        told = [infos[name] for name in INFOS]
        yield from {"observations": observations, "rewards": ended, "infos": told}.items()
        yield "states", [vec.state(), *map(vec.state_hash, worlds)]
        yield "frames", [*vec.frames().values(), *vec.final_frames().values()]
    yield "stats", [[float(vec.traffic_stats(w)[name]) for name in STATS] for w in worlds]


def drive(row: Row, way: Mapping[str, Any], folder: str) -> dict[str, str]:
    """Drive a world in one of the `WAYS`, or undivided; return the hash of each part.

    `folder` is the folder for `write_inputs`.
    """
    overrides: dict[str, Any] = {}
    for name in row.settings.split():
        for start, keys in SETTINGS[name].items():
            overrides |= {f"{start}.{key}".strip("."): value for key, value in keys.items()}
    overrides = json.loads(json.dumps(overrides).replace("FOLDER", folder))
    vec = cavmarl.make_vec(row.env, overrides=overrides, **{"zones": 1, **row.made, **way})
    found: dict[str, Any] = {}
    try:
        for part, data in _parts(row, vec):
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
        vec.close()
    return {part: found[part].hexdigest()[:32] for part in sorted(found)}


def write_inputs(folder: str) -> None:
    """Write the demand files that rows use."""
    Path(folder, "demand.rou.xml").write_text(DEMAND, "utf-8")


def run_row(name: str, folder: str) -> dict[str, str]:
    """Return the hash of each part of a row; an AssertionError names a division that differs."""
    found = drive(ROWS[name], {}, folder)
    for way in ROWS[name].ways.split():
        assert drive(ROWS[name], WAYS[way], folder) == found, way
    return found


def recorded() -> dict[str, dict[str, str]]:
    """Return the recorded hashes: row → part → hash."""
    found: dict[str, dict[str, str]] = json.loads(RECORD.read_text("utf-8"))
    return found


def main() -> None:
    """Record the rows that the command line names; if it names none, all rows."""
    parser = argparse.ArgumentParser(description="Record golden rows.")
    parser.add_argument("rows", nargs="*", metavar="ROW", help=" ".join(ROWS))
    names = parser.parse_args().rows
    unknown = [name for name in names if name not in ROWS]
    if unknown:
        parser.error(f"no row {unknown[0]}; there are {' '.join(ROWS)}")
    known = recorded()
    with tempfile.TemporaryDirectory() as folder:
        write_inputs(folder)
        for name in names or ROWS:
            found = run_row(name, folder)
            print(f"{name:16} {'same' if known.get(name) == found else 'recorded'}", flush=True)
            known[name] = found
            rows = json.dumps({row: known[row] for row in ROWS if row in known}, indent=1)
            write_whole(RECORD, f"{rows}\n".encode())


if __name__ == "__main__":
    main()
