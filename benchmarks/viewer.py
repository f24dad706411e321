"""Cost of the viewer: bytes and time of a frame, many clients, and the page's JavaScript.

Frames of generated vehicles that all move are sent through the viewer's server. With Chromium and
Playwright, the page is measured, too.
"""

from __future__ import annotations

import asyncio
import json
import multiprocessing
import resource
import shutil
import threading
from collections import deque
from multiprocessing.connection import Connection
from statistics import median
from time import perf_counter, process_time, sleep
from typing import Annotated, Any

import numpy as np
from websockets.asyncio.client import connect
from websockets.sync.client import connect as connect_now

from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, Say, paired_ratio, silent, take_turns
from cavmarl.cli.output import OptionalEnvironment, Seed, about
from cavmarl.core.errors import ConfigError
from cavmarl.engine.world_frame import SEEN, WorldFrame
from cavmarl.env.parallel import CavEnv, parallel_env
from cavmarl.env.vector import make_vec
from cavmarl.viewer.frame_messages import FrameEncoder
from cavmarl.viewer.live_env import ShownEnv
from cavmarl.viewer.map_geometry import map_origin
from cavmarl.viewer.subscribers import Audience
from cavmarl.viewer.vehicle_details import hello_of
from cavmarl.viewer.viewed_world import first_stage
from cavmarl.viewer.web_options import WebOptions
from cavmarl.viewer.web_server import WebServer

SOFTWARE_GL = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
BROWSER_HZ = 10.0
WATCHED_STEPS, WATCHED_TURNS = 200, 5


def measure(
    env: OptionalEnvironment = "grid4x4",
    vehicles: Annotated[int, about("Number of vehicles.")] = 10_000,
    clients: Annotated[int, about("Number of concurrent clients.")] = 100,
    rate_hz: Annotated[float, about("Frames per second.")] = 10.0,
    moving: Annotated[int, about("Vehicles of `town`, run with and without watchers.")] = 1000,
    seconds: Annotated[float, about("Seconds of each measurement.")] = 10.0,
    seed: Seed = 0,
    say: Say = silent,
) -> BenchmarkReport:
    """Measure the size of frames, and the time and the share of a core that the viewer takes."""
    if moving < 10:
        raise ConfigError(f"moving = {moving}: must be at least 10")
    if not (1 <= vehicles <= 100_000 and 0 <= clients <= 200 and rate_hz > 0.0 and seconds > 0.0):
        raise ConfigError(
            "vehicles must be 1 to 100000, clients 0 to 200, rate and seconds above 0"
        )
    world = parallel_env(env, agents=1, background=0)
    try:
        frames = made_up_frames(world, vehicles, seed)
        say("encoding")
        rows = [encoding(world, frames)]
        if clients:
            say(f"{clients} clients")
            rows.append(serving(world, frames, clients, rate_hz, seconds))
        say("watching a world")
        rows.append(watching(moving, seed, say))
        if shutil.which("chromium"):
            say("the page in Chromium")
            rows.append(drawing(world, frames, seconds))
    finally:
        world.close()
    columns = {
        "what": "name",
        "kB": "kb:.1f",
        "ms per frame": "ms:.2f",
        "core": "core:.0%",
        "frames/s": "fps:.1f",
        "calls": "calls",
        "first picture, ms": "first:.0f",
        "times as long": "ratio:.3f",
    }
    return BenchmarkReport(f"{vehicles} vehicles on {env}", columns, rows)


def made_up_frames(env: CavEnv, count: int, seed: int, number: int = 20) -> list[WorldFrame]:
    """Return frames of vehicles on the whole map; 1 % of them enter or leave per frame."""
    random = np.random.default_rng(seed)
    min_x, min_y, max_x, max_y = env.network.extent_m
    signals = np.zeros(len(env.network.signals), np.int32)
    signals[:] = env.network.programs["first_phase"][env.network.signals["program"]]
    frames = []
    for tick in range(number):
        rows = np.zeros(count, SEEN)
        rows["id"] = np.arange(count) + tick * (count // 100)
        rows["x"] = random.uniform(min_x, max_x, count)
        rows["y"] = random.uniform(min_y, max_y, count)
        rows["heading"] = random.uniform(-np.pi, np.pi, count)
        rows["speed"] = random.uniform(0.0, 30.0, count)
        rows["length"], rows["width"], rows["height"] = 4.6, 1.8, 1.5
        rows["agent"], rows["target_zone"] = -1, -1
        frames.append(WorldFrame(0, tick, tick / 10.0, rows, signals))
    return frames


def encoding(env: CavEnv, frames: list[WorldFrame]) -> dict[str, Any]:
    encoder = FrameEncoder(map_origin(env.network))
    spent, sizes = [], []
    for frame in frames:
        begun = perf_counter()
        shown = encoder.publication(frame)
        spent.append(perf_counter() - begun)
        sizes.append(len(shown.frame) + len(shown.roster[-1].message))
    return {"name": "publishing", "kb": median(sizes[1:]) / 1e3, "ms": 1e3 * median(spent)}


def serving(
    env: CavEnv, frames: list[WorldFrame], clients: int, rate_hz: float, seconds: float
) -> dict[str, Any]:
    """Measure the server's CPU time while clients in another process read all frames."""
    audience, server, encoder = served(env)
    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    reader = multiprocessing.get_context("spawn").Process(
        target=read_all, args=(server.address, clients, seconds, theirs)
    )
    with server:
        reader.start()
        while audience.wishes.watchers < clients:
            sleep(0.05)
        ours.send("begin")
        begun, cpu = perf_counter(), process_time()
        sent = 0
        while perf_counter() - begun < seconds:
            audience.publish(encoder.publication(frames[0]._replace(tick=sent)))
            sent += 1
            sleep(max(0.0, begun + sent / rate_hz - perf_counter()))
        took, cpu = perf_counter() - begun, process_time() - cpu
        received = ours.recv()
        reader.join()
    return {
        "name": f"{clients} clients, {rate_hz:g} Hz",
        "core": cpu / took,
        "ms": 1e3 * cpu / sent,
        "fps": received / clients / took,
    }


def watching(vehicles: int, seed: int, say: Say) -> dict[str, Any]:
    """Compare the steps of a town with and without a watching client, in turn.

    Processor time of this process is measured, which includes server and client.
    """
    agents = vehicles // 10
    vec = make_vec("town", seed=seed, agents=agents, background=vehicles - agents)
    shown = ShownEnv(vec, WebOptions(port=0, control=False))
    try:
        vec.reset()
        url = shown.address.replace("http", "ws") + "live"

        def steps_s() -> float:
            took = 0.0
            for _ in range(WATCHED_STEPS):
                actions = vec.suggest_actions()
                begun = process_time()
                vec.step(actions)
                took += process_time() - begun
            return took

        def watched_s() -> float:
            with connect_now(url, max_size=None, compression=None) as client:
                client.send("{}")
                for _ in range(2):  # hello and map
                    client.recv()
                reader = threading.Thread(target=lambda: deque(client, maxlen=0), daemon=True)
                reader.start()
                took = steps_s()
            reader.join()
            return took

        steps_s()
        found = take_turns({"alone": steps_s, "watched": watched_s}, WATCHED_TURNS, say)
    finally:
        shown.close()
        vec.close()
    ratio = paired_ratio(found["watched"], found["alone"])
    return {
        "name": f"watched step of {vehicles}",
        "ms": 1e3 * median(found["watched"]) / WATCHED_STEPS,
        "ratio": ratio,
    }


def read_all(address: str, clients: int, seconds: float, pipe: Connection) -> None:
    """Watch with a number of clients and send the number of frames received."""
    resource.setrlimit(
        resource.RLIMIT_NOFILE, (1024, resource.getrlimit(resource.RLIMIT_NOFILE)[1])
    )
    pipe.send(asyncio.run(_read(address, clients, seconds, pipe)))


async def _read(address: str, clients: int, seconds: float, pipe: Connection) -> int:
    counts = [0] * clients

    async def watch(k: int) -> None:
        url = address.replace("http", "ws") + "live"
        async with connect(url, max_size=None, compression=None) as client:
            await client.send("{}")
            async for message in client:
                counts[k] += not isinstance(message, str) and message[0] == 3

    tasks = [asyncio.create_task(watch(k)) for k in range(clients)]
    await asyncio.to_thread(pipe.recv)
    before = sum(counts)
    await asyncio.sleep(seconds)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    return sum(counts) - before


def drawing(env: CavEnv, frames: list[WorldFrame], seconds: float) -> dict[str, Any]:
    """Measure the JavaScript of the page's main thread; the time of software GL does not count."""
    from playwright.sync_api import sync_playwright

    audience, server, encoder = served(env)
    audience.publish(encoder.publication(frames[0]))
    with server, sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=SOFTWARE_GL
        )
        page = browser.new_page(viewport={"width": 1280, "height": 720})
        page.goto(server.address)
        begun, sent = perf_counter(), 0
        while perf_counter() - begun < seconds:
            audience.publish(encoder.publication(frames[sent % len(frames)]._replace(tick=sent)))
            sent += 1
            page.wait_for_timeout(1e3 / BROWSER_HZ)
        times = json.loads(
            page.evaluate(
                "JSON.stringify({draw: viewer.times, take: viewer.takes, calls: viewer.calls, "
                "first: viewer.firstPicture, n: viewer.frame.count})"
            )
        )
        browser.close()
    return {
        "name": "page",
        "ms": median(times["draw"]) + median(times["take"]),
        "draw_ms": median(times["draw"]),
        "take_ms": median(times["take"]),
        "calls": times["calls"],
        "first": times["first"],
    }


def served(env: CavEnv) -> tuple[Audience, WebServer, FrameEncoder]:
    stage = first_stage("world 0", env.network, hello_of(env, "none"))
    return stage.audience, WebServer(WebOptions(port=0), [stage]), stage.encoder


if __name__ == "__main__":
    run(measure)
