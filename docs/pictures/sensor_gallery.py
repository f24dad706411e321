"""Draw a picture for each sensor: its data for one agent, over the world around the agent.

`python -m docs.pictures.sensor_gallery docs/images/sensors` draws them again.
"""

from __future__ import annotations

import base64
import math
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.env.parallel import CavEnv, parallel_env
from cavmarl.render.canvas import load_pygame
from cavmarl.render.topdown import TopDownRenderer
from cavmarl.sensors.observed import feature_names
from cavmarl.sensors.registry import sensor_names
from cavmarl.viewer.vehicle_details import sensed_shapes

if TYPE_CHECKING:
    from pygame import Surface

ENV, AGENT, STEPS = "grid4x4", 1, 90
SIZE, SEES_M = (560, 360), 36.0  # size in pixels; range to either side in m
INK, DARK = (200, 40, 120), (28, 32, 40)
EVERY = {
    "sensors.lidar.rays": 96,
    "sensors.neighbors.count": 8,
    "v2x.enabled": True,
    "sensors.kinematics.vehicles_count": 8,
    "sensors.occupancy_grid.features": ["presence", "on_road"],
    "sensors.lidar_observation.cells": 48,
    "sensors.way.distances_m": [5.0, 10.0, 20.0, 40.0],
    "sensors.way.lines": 1,
    "sensors.conflicts.count": 4,
    "sensors.history.steps": 3,
    "sensors.messages.objects": 4,
}
MOUNT = {"x_m": 0.5, "z_m": 1.5, "rate_hz": 10}
CARRIED: dict[str, dict[str, Any]] = {
    "lidar": {"layers": 16, "rays": 360, "z_m": 1.6},
    "radar": {"x_m": 2.5, "z_m": 0.5, "fov_deg": 90},
    **{f"{kind}_camera": {"width": 480, "height": 270} for kind in ("depth", "semantic", "rgb")},
}


def world_with_every_sensor() -> CavEnv:
    """Return a crossing whose agents have all sensors, some seconds after the reset."""
    carried = [name.removeprefix("rig.") for name in sensor_names() if name.startswith("rig.")]
    overrides: dict[str, Any] = {
        **EVERY,
        "map.buildings": "map/buildings.poly.xml",
        "rig": {
            kind: {"type": kind, **({} if kind == "collision" else MOUNT), **CARRIED.get(kind, {})}
            for kind in carried
        },
    }
    env = parallel_env(ENV, agents=AGENT + 1, background=90, overrides=overrides)
    env.reset(seed=3)
    for _ in range(STEPS):
        env.step(env.suggest_actions())
    return env


def _drawn(env: CavEnv, kind: str, is_carried: bool) -> Surface:
    simulation, arrays = env.simulation, env.worlds.arrays
    rows = simulation.vehicles(0)
    row = rows[rows["agent"] == AGENT][0]
    named = [one for one in sensed_shapes(env.config, arrays, 0, AGENT) if one["name"] == kind]
    observed = [one for one in named if one["kind"] not in ("picture", "numbers")]
    # If an observed and a mounted sensor have the same name, the mounted sensor is last.
    shapes = named[-1:] if is_carried else observed[:1]
    for shape in shapes:
        if shape["kind"] == "picture":
            return _scaled(_image(shape))
    aspect = SIZE[0] / SIZE[1]
    focus = (
        row["x"] - SEES_M * aspect, row["y"] - SEES_M, row["x"] + SEES_M * aspect, row["y"] + SEES_M
    )  # fmt: skip
    renderer = TopDownRenderer(env.network, SIZE, focus)
    picture = renderer.draw(rows, simulation.signal_phases())
    told = [shape["rows"] for shape in shapes if shape["kind"] == "numbers"]
    if told:
        return _with_text(picture, [f"{number:.3f} {unit}" for unit, number in told[0]])
    if shapes:
        for shape in shapes:
            _overlay(picture, renderer, shape, row)
        return picture
    names = [] if is_carried else _features(env, kind)
    return _with_text(picture, names)


def _features(env: CavEnv, kind: str) -> list[str]:
    numbers = env.worlds.arrays.observations[0, AGENT]
    names = feature_names(env.config.sensors)
    rows = [(one, number) for one, number in zip(names, numbers, strict=True) if one[0] == kind]
    return [f"{feature} {number:.3f}" for (_, feature), number in rows][:18]


def _overlay(picture: Surface, renderer: TopDownRenderer, shape: dict[str, Any], row: Any) -> None:
    pygame = load_pygame()
    heading = float(row["heading"]) if shape["axes"] == "vehicle" else 0.0
    turn = np.array(
        [[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]]
    )

    def pixels(flat: Iterable[float]) -> NDArray[np.float64]:
        places = np.asarray(list(flat), np.float64).reshape(-1, 2) @ turn.T
        return renderer.camera.to_pixels(places + np.array([row["x"], row["y"]]))

    if shape["kind"] == "rays":
        (start,) = pixels(shape["from"])
        for end, hit in zip(pixels(shape["ends"]), shape["hits"], strict=True):
            pygame.draw.aaline(picture, INK if hit else (150, 160, 175), start, end)
    elif shape["kind"] == "grid":
        first, second, third = pixels(shape["corners"])
        image = pygame.image.frombuffer(
            _image(shape).tobytes(), (shape["width"], shape["height"]), "RGBA"
        )
        width, height = (int(np.hypot(*(end - first))) + 1 for end in (second, third))
        angle = -math.degrees(math.atan2(*(second - first)[::-1]))
        turned = pygame.transform.rotate(pygame.transform.scale(image, (width, height)), angle)
        picture.blit(turned, turned.get_rect(center=tuple((second + third) / 2.0)))
    else:
        (start,) = pixels([0.0, 0.0])
        for place in pixels(shape["points"]):
            if shape["kind"] == "links":
                pygame.draw.aaline(picture, INK, start, place)
            pygame.draw.circle(picture, INK, place, 2.5)


def _image(shape: dict[str, Any]) -> NDArray[np.uint8]:
    raw = np.frombuffer(base64.b64decode(shape["rgba"]), np.uint8)
    return raw.reshape(shape["height"], shape["width"], 4)


def _scaled(image: NDArray[np.uint8]) -> Surface:
    pygame = load_pygame()
    surface = pygame.image.frombuffer(image.tobytes(), image.shape[1::-1], "RGBA").convert(24)
    return pygame.transform.smoothscale(
        surface, (SIZE[0], round(SIZE[0] * image.shape[0] / image.shape[1]))
    )


def _with_text(picture: Surface, lines: list[str]) -> Surface:
    pygame = load_pygame()
    font = pygame.font.Font(None, 20)
    lines = lines or ["nothing now"]
    box = pygame.Surface((230, 12 + 18 * len(lines)))
    box.fill((252, 252, 250))
    for k, line in enumerate(lines):
        box.blit(font.render(line, True, DARK), (8, 6 + 18 * k))
    picture.blit(box, (8, 8))
    return picture


def write_sensor_gallery(folder: Path) -> list[Path]:
    """Draw all pictures into a folder."""
    pygame = load_pygame()
    pygame.font.init()
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    env = world_with_every_sensor()
    for name in sensor_names():
        kind = name.removeprefix("rig.")
        paths.append(folder / f"{name.replace('rig.', 'rig_')}.png")
        pygame.image.save(_drawn(env, kind, is_carried=name != kind), str(paths[-1]))
    env.close()
    return paths


if __name__ == "__main__":
    for path in write_sensor_gallery(Path(sys.argv[1])):
        print(path)
