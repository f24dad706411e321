"""CARLA's public programs run unchanged, except for the host, the port and the map.

`CAVMARL_CARLA_SCRIPTS` names a folder with `PythonAPI` and `Co-Simulation` of CARLA's release
0.9.16. The programs need packages in the Python of CARLA's client: numpy, pygame, networkx and
shapely; and lxml for the co-simulation with SUMO.
"""

from __future__ import annotations

import os
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from cavmarl.engine.world_setup import find_map
from tests.cosim.carla.conftest import VERSION, client_python, run_client, running_server
from tests.support.demand_worlds import TINY

SCRIPTS = "CAVMARL_CARLA_SCRIPTS"
ENDS_S = 60.0

# Older releases of SUMO's `traci` have `sumolib` as an attribute, which the program uses.
RUN_WITH_SUMO = """
import os, runpy, sys
sys.path[:0] = [os.getcwd(), os.path.join(os.environ["SUMO_HOME"], "tools")]
import sumolib, traci
traci.sumolib = sumolib
sys.argv = ["run_synchronization.py", *sys.argv[1:]]
runpy.run_path("run_synchronization.py", run_name="__main__")
"""


def folder(*parts: str) -> Path:
    """Return a folder of CARLA's release; skip the test if there is none."""
    found = os.environ.get(SCRIPTS)
    if found is None or not Path(found, *parts).is_dir():
        pytest.skip(f"CARLA's programs are missing: set {SCRIPTS} to a folder with {parts[0]}")
    return Path(found, *parts)


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    with running_server(agents=2, background=6) as found:
        yield found


def start_program(words: list[str], where: Path, **more: str) -> subprocess.Popen[str]:
    quiet = {"SDL_VIDEODRIVER": "dummy", "SDL_AUDIODRIVER": "dummy", "MPLBACKEND": "Agg"}
    agents = str(folder("PythonAPI", "carla"))
    return subprocess.Popen(
        [client_python(VERSION), "-u", *words],
        cwd=where,
        env={**os.environ, **quiet, "PYTHONPATH": agents, **more},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def interrupt(process: subprocess.Popen[str]) -> str:
    """Interrupt a program, as a user does, and return its output."""
    process.send_signal(signal.SIGINT)
    try:
        return process.communicate(timeout=ENDS_S)[0]
    finally:
        process.kill()


def output_after(process: subprocess.Popen[str], mark: str) -> str:
    """Interrupt a program once its output contains `mark`; return all its output."""
    watch = threading.Timer(ENDS_S, process.kill)
    watch.start()
    seen = ""
    assert process.stdout is not None
    for line in process.stdout:
        seen += line
        if mark in line:
            break
    watch.cancel()
    return seen + interrupt(process)


def test_the_script_config_py_runs(port: int) -> None:
    where = folder("PythonAPI", "util")
    for words, told in (
        (["--inspect"], "vehicles:                    8"),
        (["--list"], "grid4x4"),
        (["--map", "intersection"], "load map 'intersection'"),
        (["--map", "grid4x4", "--delta-seconds", "0.05"], "set fixed frame rate 50.00"),
    ):
        process = start_program(["config.py", "--port", str(port), *words], where)
        text, _ = process.communicate(timeout=ENDS_S)
        assert told in text
        assert process.returncode == 0


def test_the_script_generate_traffic_py_runs(port: int) -> None:
    words = ["generate_traffic.py", "--port", str(port), "-n", "10", "-w", "0", "--seed", "1"]
    where = folder("PythonAPI", "examples")
    text = output_after(start_program(words, where), "press Ctrl+C to exit")
    assert "spawned 10 vehicles and 0 walkers" in text
    assert "destroying 10 vehicles" in text
    assert "Traceback" not in text.partition("KeyboardInterrupt")[0]


@pytest.mark.parametrize("name", ["synchronous_mode.py", "sensor_synchronization.py"])
def test_programs_get_the_sensor_frames_of_each_tick(name: str, tmp_path: Path) -> None:
    """The programs drive random routes, so they need a map without dead ends."""
    where = folder("PythonAPI", "examples")
    copy = tmp_path / name
    with running_server(agents=1, background=0, env="ring") as port:
        copy.write_text((where / name).read_text("utf-8").replace("2000", str(port)), "utf-8")
        for _ in range(5):
            process = start_program([str(copy)], where)
            with suppress(subprocess.TimeoutExpired):  # the program runs until it is interrupted
                process.wait(8.0)
            text = interrupt(process)
            if "Spawn failed because of collision" not in text:  # the random place is occupied
                break
    assert "Cancelled by user. Bye!" in text or "Exited by user." in text, text
    assert "Traceback" not in text
    assert name == "synchronous_mode.py" or text.count("Frame: ") > 60


def test_agents_navigation_finds_routes_between_spawn_points() -> None:
    """Lanes that cars may not use, or spawn points on roads out of the map, would have no route."""
    agents = str(folder("PythonAPI", "carla"))
    with running_server(agents=1, background=0, env="town") as port:
        found = run_client(
            port,
            f"sys.path.insert(0, {agents!r})\n"
            + """
import random
from agents.navigation.global_route_planner import GlobalRoutePlanner
planner = GlobalRoutePlanner(world.get_map(), 2.0)
points = [one.location for one in world.get_map().get_spawn_points()]
random.seed(1)
found["pairs"] = found["routes"] = 0
for _ in range(60):
    found["pairs"] += 1
    try:
        found["routes"] += len(planner.trace_route(*random.sample(points, 2))) > 1
    except Exception as error:
        found["error"] = repr(error)
""",
        )
    assert found["pairs"] == 60
    assert found["routes"] >= 58, found


def test_sumo_and_the_world_show_each_other_their_vehicles(port: int, tmp_path: Path) -> None:
    sumo = pytest.importorskip("sumo", reason="needs the extra 'sumo'")
    where = folder("Co-Simulation", "Sumo")
    (tmp_path / "grid.rou.xml").write_text(
        TINY["grid4x4"].replace('"car"', '"vehicle.tesla.model3"'), encoding="utf-8"
    )
    (tmp_path / "grid.sumocfg").write_text(
        f'<configuration><input><net-file value="{find_map("grid4x4")}"/>'
        '<route-files value="grid.rou.xml"/></input></configuration>',
        encoding="utf-8",
    )
    words = ["-c", RUN_WITH_SUMO, str(tmp_path / "grid.sumocfg"), "--carla-port", str(port)]
    process = start_program([*words, "--step-length", "0.05"], where, SUMO_HOME=sumo.SUMO_HOME)
    try:
        found = run_client(
            port,
            """
import time
until = time.monotonic() + 60.0
while time.monotonic() < until:
    world.wait_for_tick(60.0)
    seen = [one for one in world.get_actors().filter("vehicle.*")
            if one.attributes["role_name"] == "sumo_driver"]
    if len(seen) >= 5:
        break
road_map = world.get_map()
moved, away = 0.0, []
for step in range(40):
    world.wait_for_tick(10.0)
    for one in seen:
        here = one.get_location()
        if one.is_alive and (here.x or here.y):
            away.append(here.distance(road_map.get_waypoint(here).transform.location))
            moved = max(moved, one.get_velocity().length())
found["vehicles"] = len(seen)
found["away"] = sorted(away)[len(away) // 2]
found["speed"] = moved
""",
        )
    finally:
        text = interrupt(process)
    assert found["vehicles"] >= 5, text
    assert found["away"] < 0.5
    assert found["speed"] > 3.0
    assert "Cleaning synchronization" in text


def test_a_run_is_recorded_shown_and_replayed(tmp_path: Path) -> None:
    where = folder("PythonAPI", "examples")
    with running_server(env="town", agents=1, background=2, recordings=tmp_path) as port:

        def run(name: str, *words: str) -> str:
            process = start_program([name, "--port", str(port), *words], where)
            text, _ = process.communicate(timeout=ENDS_S)
            assert process.returncode == 0, text
            assert "Traceback" not in text
            return text

        text = run("start_recording.py", "-n", "4", "-t", "3")
        assert f"Recording on file: {tmp_path / 'test1.log'}" in text
        assert "spawned 4 vehicles" in text
        text = run("show_recorder_file_info.py", "-f", "test1.log")
        assert text.count("role_name = autopilot") == 4
        text = run("start_replaying.py", "-s", "1", "-d", "2")
        assert "Replaying from 1 s - 3 s" in text
