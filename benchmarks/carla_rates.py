"""Ticks per second of a world that CARLA's client ticks, and delays of its sensors' frames."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, NamedTuple

import numpy as np

from benchmarks import carla_client
from benchmarks.carla_clock import serving
from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, silent
from cavmarl.cli.output import OptionalEnvironment, about, with_world
from cavmarl.config.world_spec import WorldSpec
from cavmarl.cosim.carla.client_process import client_python, run_client_program

_SMALL = {"image_size_x": 320, "image_size_y": 180}
_LIDAR = {"channels": 64, "points_per_second": 100_000, "range": 100, "rotation_frequency": 20}
LIDAR_AND_CAMERA = (
    {"blueprint": "sensor.lidar.ray_cast", "attributes": _LIDAR},
    {"blueprint": "sensor.camera.rgb", "attributes": _SMALL},
)
TEN_SENSORS = (
    *LIDAR_AND_CAMERA,
    {"blueprint": "sensor.camera.rgb", "attributes": {**_SMALL, "fov": 120}},
    {"blueprint": "sensor.camera.depth", "attributes": _SMALL},
    {"blueprint": "sensor.camera.semantic_segmentation", "attributes": _SMALL},
    {"blueprint": "sensor.camera.instance_segmentation", "attributes": _SMALL},
    {"blueprint": "sensor.lidar.ray_cast_semantic", "attributes": {"channels": 16}},
    {"blueprint": "sensor.other.radar"},
    {"blueprint": "sensor.other.gnss"},
    {"blueprint": "sensor.other.imu"},
)


class Load(NamedTuple):
    """The sensors and the required rate of a client."""

    name: str
    vehicles: int
    sensors: tuple[dict[str, Any], ...]
    at_least: float  # required ticks per second on an idle machine; shown, but not checked


LOADS = (
    Load("1 vehicle", 1, (), 500.0),
    Load("50 vehicles", 50, (), 200.0),
    Load("lidar of 64 channels, camera of 320 x 180", 50, LIDAR_AND_CAMERA, 20.0),
    Load("ten sensors", 50, TEN_SENSORS, 0.0),
)


@with_world("seed", "settings")
def measure(
    world: WorldSpec,
    env: OptionalEnvironment = "grid4x4",
    ticks: Annotated[int, about("Ticks of each load.")] = 1000,
    say: Say = silent,
) -> BenchmarkReport:
    """Measure worlds that CARLA's client ticks; fail if a frame of a sensor is missing."""
    rows: list[dict[str, Any]] = []
    for load in LOADS:
        say(load.name)
        rows.append(measure_load(world, load, ticks))
    lost = sum(row["lost"] for row in rows)
    return BenchmarkReport(
        f"{Path(world.env).name}, {ticks} ticks",
        {
            "load": "load",
            "vehicles": "vehicles",
            "start, s": "start_s:.1f",
            "ticks/s": "ticks_per_s:.0f",
            "required": "at_least:.0f",
            "frames lost": "lost",
        },
        rows,
        notes=[
            f"{sensor['name']}: frame after {sensor['median_ms']:.1f} ms, 95 % after at most "
            f"{sensor['usual_ms']:.1f} ms, all after at most {sensor['largest_ms']:.1f} ms"
            for sensor in rows[-1]["sensors"]
        ],
        facts={"rows": rows, "lost": lost},
        holds=lost == 0,
    )


def measure_load(spec: WorldSpec, load: Load, ticks: int) -> dict[str, Any]:
    """Return the rate of a load, and the delays of its sensors.

    Raises:
        ClientProgramError: the client fails.
        MissingExtraError: CARLA's client, or an extra, is not installed.
    """
    check_range(ticks=(ticks, 1, float("inf")))
    client_python()
    wanted = replace(spec, agents=1, background=load.vehicles - 1)
    begin_s = time.perf_counter()
    with TemporaryDirectory() as folder, serving(wanted, "obey") as server:
        start_s = time.perf_counter() - begin_s
        sensors, output = Path(folder) / "sensors.json", Path(folder) / "found.json"
        sensors.write_text(json.dumps(load.sensors), encoding="utf-8")
        run_client_program(
            Path(carla_client.__file__), (server.port, ticks, sensors, output), timeout_s=3600.0
        )
        found = json.loads(output.read_text(encoding="utf-8"))
    sensors_found = []
    for sensor in found["sensors"]:
        delays_ms = np.array(sensor["delays_ms"])
        sensors_found.append(
            {
                "name": sensor["name"],
                "median_ms": float(np.median(delays_ms)),
                "usual_ms": float(np.quantile(delays_ms, 0.95)),
                "largest_ms": float(delays_ms.max()),
                "lost": ticks - len(delays_ms),
            }
        )
    return {
        "load": load.name,
        "vehicles": found["vehicles"],
        "start_s": start_s,
        "ticks_per_s": ticks / found["wall_s"],
        "at_least": load.at_least,
        "lost": sum(sensor["lost"] for sensor in sensors_found),
        "sensors": sensors_found,
    }


if __name__ == "__main__":
    run(measure)
