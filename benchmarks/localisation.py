"""Localisation error of the reference stack, without and with scan matching.

The built-in driver drives. Both stages, without and with scan matching, get the same sensor data.
The first seconds are left out.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np

import cavmarl
from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, numbers_of, silent
from cavmarl.cli.output import OptionalEnvironment, Settings, about, parse_settings
from cavmarl.core.errors import ConfigError
from cavmarl.cosim.followers.follower_client import FollowerView, sight_of
from cavmarl.cosim.followers.follower_snapshots import SnapshotTime, take_snapshot, welcome_to
from cavmarl.cosim.stack.hd_map import HdMap
from cavmarl.cosim.stack.localisation import GnssInertial
from cavmarl.cosim.stack.scan_matching import ScanMatching
from cavmarl.cosim.stack.stack import REFERENCE_RIG, sensor_of, vehicle_of
from cavmarl.cosim.stack.stack_types import Mission
from cavmarl.env.parallel import CavEnv
from cavmarl.maps.fidelity.cloud_files import Cloud, write_cloud
from cavmarl.maps.fidelity.map_surface import map_surface

AGENT = "car_0"
STEP_S = 0.05
STAGES = {"gnss_imu": "filter", "scan_matching": "scans"}  # names in the table
CLOUD_SPACING_M, CLOUD_NOISE_M = 0.4, 0.03  # points on the surface of the map


def measure(
    env: OptionalEnvironment = "grid4x4",
    cloud: Annotated[Path | None, about("Point-cloud map [default: the map's surface].")] = None,
    buildings: Annotated[str, about("Buildings, as in map.buildings.")] = "map/buildings.poly.xml",
    noise: Annotated[float, about("Standard deviation of GNSS noise, m.")] = 1.0,
    bias: Annotated[float, about("Standard deviation of GNSS bias, east and north, m.")] = 0.0,
    markings: Annotated[bool, about("Use a sensor for lane markings.")] = True,
    time_s: Annotated[float, about("Simulated seconds per drive.")] = 35.0,
    skip_s: Annotated[float, about("Seconds to leave out at the beginning.")] = 5.0,
    background: Annotated[int, about("Number of background vehicles.")] = 20,
    seeds: Annotated[str, about("Comma-separated seeds, one drive each.")] = "1,2,3",
    settings: Settings = None,
    say: Say = silent,
) -> BenchmarkReport:
    """Measure the position error with GNSS, IMU and odometry, and with scan matching."""
    check_range(time_s=(time_s, 1.0, 3600.0), skip_s=(skip_s, 0.0, time_s - STEP_S))
    check_range(noise=(noise, 0.0, 100.0), bias=(bias, 0.0, 100.0))
    overrides = {
        "rig": rig_with(noise, bias, markings),
        "clock.ctrl_dt_s": STEP_S,
        "map.buildings": buildings,
        **parse_settings(settings),
    }
    world = cavmarl.parallel_env(env, agents=1, background=background, overrides=overrides)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        if cloud is None:
            cloud = write_surface(world, Path(folder) / "surface.ply")
        for seed in numbers_of("--seeds", seeds):
            say(f"seed {seed}")
            rows.append(_row(world, cloud, seed, round(time_s / STEP_S), round(skip_s / STEP_S)))
    columns = {"seed": "seed", "GNSS": "bias_m:.2f"}
    for stage, short in STAGES.items():
        columns[f"{short} mean"] = f"{stage}_mean_m:.3f"
        columns[f"{short} 95 %"] = f"{stage}_p95_m:.3f"
    columns |= {"used": "matched", "refused": "refused", "ms": "step_ms:.1f"}
    notes = [
        "GNSS: length of the mean error of the fixes; used, refused: numbers of scans; "
        "ms: processor time per step"
    ]
    title = f"position error, m: GNSS {noise:g} m of noise, {bias:g} m of bias"
    return BenchmarkReport(title + ("" if markings else ", no lane markings"), columns, rows, notes)


def rig_with(noise_m: float, bias_m: float, markings: bool) -> dict[str, dict[str, Any]]:
    """Return the reference rig with these GNSS errors."""
    rig = {name: dict(keys) for name, keys in REFERENCE_RIG.items()}
    rig["gnss"] |= {"noise": [noise_m, noise_m, 2.0 * noise_m], "bias": [bias_m, bias_m, 0.0]}
    if not markings:
        del rig["markings"]
    return rig


def write_surface(world: CavEnv, path: Path) -> Path:
    """Write the map's lanes and walls as a point cloud."""
    surface, _ = map_surface(world.network, world.network.extent_m, CLOUD_SPACING_M)
    noise = np.random.default_rng(0).normal(0.0, CLOUD_NOISE_M, surface.points.shape)
    write_cloud(path, Cloud("surface", surface.points + noise))
    return path


def _row(world: CavEnv, cloud: Path, seed: int, steps: int, skipped: int) -> dict[str, Any]:
    drive = Drive(world, cloud, seed)
    for _ in range(steps):
        if not drive.step():
            break
    if drive.steps <= skipped:
        raise ConfigError(f"seed {seed}: the trip ends before --skip-s: choose another seed")
    row: dict[str, Any] = {"seed": seed, "bias_m": float(np.hypot(*np.mean(drive.fixes_m, 0)))}
    for stage in STAGES:
        off = np.array(drive.off_m[stage][skipped:])
        row |= {
            f"{stage}_mean_m": float(off.mean()),
            f"{stage}_p95_m": float(np.quantile(off, 0.95)),
        }
    matching = drive.stages["scan_matching"]
    assert isinstance(matching, ScanMatching)
    row |= {"matched": matching.matched, "refused": matching.refused, "lost": matching.lost}
    return row | {"step_ms": 1e3 * drive.busy_s / drive.steps}


class Drive:
    """One trip of the first agent, located by each stage.

    Attributes:
        off_m: position errors of each stage, one per step.
        fixes_m: errors of fixes, east and north.
        busy_s: processor time of scan matching.
    """

    def __init__(self, world: CavEnv, cloud: Path, seed: int) -> None:
        self._world = world
        world.reset(seed=seed)
        sensors = [sensor_of(v.name, v.settings) for v in welcome_to(world, [AGENT], 0).sensors]
        vehicle = vehicle_of(HdMap(world.network), sensors, STEP_S, cloud)
        if vehicle.geodesy is None:
            raise ConfigError(f"{world.network.name}: no GNSS is mounted; do not override `rig`")
        self._geodesy = vehicle.geodesy
        kept = (sensors, vehicle.geodesy, vehicle.hd_map, STEP_S)
        self.stages: Mapping[str, GnssInertial] = {
            "gnss_imu": GnssInertial(*kept),
            "scan_matching": ScanMatching(*kept, cloud),
        }
        self.off_m: dict[str, list[float]] = {stage: [] for stage in STAGES}
        self.fixes_m: list[tuple[float, float]] = []
        self.busy_s = 0.0
        self.steps = 0

    def step(self) -> bool:
        """Locate the vehicle and run a step; return False if the trip has ended."""
        world = self._world
        if AGENT not in world.agents:
            return False
        tick = int(world.worlds.ticks()[0])
        sight = sight_of(*take_snapshot(world, [0], SnapshotTime(self.steps, 0, tick, False)))
        rows = world.simulation.vehicles()
        self._locate(sight, rows[rows["agent"] == 0][0])
        self.steps += 1
        world.step(world.suggest_actions())
        return True

    def _locate(self, sight: FollowerView, row: np.void) -> None:
        view = sight.snapshot.vehicles[AGENT]
        readings = sight.sensors[AGENT]
        mission = Mission(0, view.vclass, view.length_m, view.width_m)
        fix = readings.get("gnss")
        if fix is not None and not fix.lost.all():
            x_m, y_m, _ = self._geodesy.to_map(fix.values[~fix.lost][-1:])[0]
            self.fixes_m.append((x_m - float(row["x"]), y_m - float(row["y"])))
        for name, stage in self.stages.items():
            began_s = time.process_time()
            pose = stage.locate(readings, mission, sight.snapshot.time_s)
            if name == "scan_matching":
                self.busy_s += time.process_time() - began_s
            if pose is None:
                self.off_m[name].append(math.nan)
            else:
                off_m = math.hypot(pose.x_m - float(row["x"]), pose.y_m - float(row["y"]))
                self.off_m[name].append(off_m)


if __name__ == "__main__":
    run(measure)
