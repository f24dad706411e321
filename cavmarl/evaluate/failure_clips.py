"""Failed trips of an evaluation: their causes, and their surroundings in the last ten seconds."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.engine.world_frame import WorldFrame
from cavmarl.sensors.sensed_shapes import Shape, observed_shapes

CLIP_S = 10.0
REACH_M = 70.0  # greatest distance in x and in y from the end of the trip that a clip shows
MOST_KEPT_BYTES = 256 << 20  # limit of memory for observations
NO_SENSORS = "observes nothing that can be drawn"
TOO_MANY = f"observations of ten seconds are more than {MOST_KEPT_BYTES >> 20} MB and were not kept"
_DRAWN = ("rays", "links")  # the kinds of shapes that the page draws

# Causes, worst first.
FATES = ("collision", "off_road", "red_light", "wrong_way", "stood", "blocked", "out_of_time")
CAUSES = (*FATES, "slow")


@dataclass(frozen=True)
class Failure:
    """A failed trip."""

    cause: str  # one of `CAUSES`
    severity: float  # higher is worse within a cause: m/s, or s of delay
    trip: Mapping[str, Any]  # policy, run, seed, episode, agent, when and where the trip ended
    clip: Mapping[str, Any]  # `vehicles` and `frames` from `clip_of`


class FailureClips:
    """Keeps the last seconds of worlds, and the worst failures of each cause.

    Args:
        most: number of failures to keep.
        config: configuration of the worlds.
        about: values for each trip: policy, run, seed.
        observations: (W, A, D) observations of the agents, as the last step wrote them.
    """

    def __init__(
        self,
        most: int,
        config: EnvConfig,
        about: Mapping[str, Any],
        observations: NDArray[np.float32],
    ) -> None:
        self._most = most
        self._config = config
        self._about = dict(about)
        self._step_s = step_s = config.clock.ctrl_dt_s
        self._length = max(2, math.ceil(CLIP_S / step_s) + 1)
        self._observations = observations
        self._keeps = self._length * observations.nbytes <= MOST_KEPT_BYTES
        # world → its last frames, each with observations (A, D) if they are kept
        self._recent: dict[int, deque[tuple[WorldFrame, NDArray[np.float32] | None]]] = {}
        self.failures: list[Failure] = []

    def begin(self) -> None:
        """Discard all frames when the worlds begin other episodes."""
        self._recent.clear()

    def add(self, frames: Iterable[WorldFrame]) -> None:
        """Record the present frames of worlds."""
        for frame in frames:
            kept = self._recent.setdefault(frame.world, deque(maxlen=self._length))
            kept.append((frame, self._observations[frame.world].copy() if self._keeps else None))

    def take(self, trips: NDArray[np.void], first: int) -> None:
        """Keep the failed trips among `trips`, which ended in the step after the last frames.

        Args:
            trips: TRIP (n,); `episode` is their world.
            first: episode of world 0.
        """
        for trip in trips[trips["counted"] & ~trips["success"]]:
            recent = list(self._recent.get(int(trip["episode"]), ()))
            if recent:
                self.failures.append(self._failure(trip, recent, first))
        if len(self.failures) > 4 * self._most:
            self.failures = worst(self.failures, self._most)

    def _failure(
        self,
        trip: np.void,
        recent: Sequence[tuple[WorldFrame, NDArray[np.float32] | None]],
        first: int,
    ) -> Failure:
        frames = [frame for frame, _ in recent]
        last = frames[-1]
        mine = last.vehicles[last.vehicles["agent"] == trip["agent"]]
        row = mine[0] if len(mine) else None
        speed = float(trip["mean_speed_mps"] if row is None else row["speed"])
        cause = cause_of(trip)
        by_delay = cause in ("stood", "blocked", "out_of_time", "slow")
        place = trip if row is None else row
        names = ("end_x_m", "end_y_m") if row is None else ("x", "y")
        center = tuple(round(float(place[name]), 2) for name in names)
        told = {
            **self._about,
            "episode": first + int(trip["episode"]),
            "agent": int(trip["agent"]),
            "vehicle": -1 if row is None else int(row["id"]),
            "began_s": round(float(trip["began_s"]), 2),
            "duration_s": round(float(trip["duration_s"]), 2),
            "speed_mps": round(speed, 2),
            "delay_s": round(float(trip["delay_s"]), 2),
            "center_m": center,
            "step_s": self._step_s,
        }
        severity = float(trip["delay_s"]) if by_delay else abs(speed)
        clip = clip_of(frames, (center[0], center[1]))
        sensed = [self._sensed(*one, told["agent"], told["vehicle"]) for one in recent]
        note = "" if any(sensed) else NO_SENSORS if self._keeps else TOO_MANY
        clip |= {"sensors": sensed if any(sensed) else [], "sensors_note": note}
        return Failure(cause, severity, told, clip)

    def _sensed(
        self, frame: WorldFrame, kept: NDArray[np.float32] | None, agent: int, vehicle: int
    ) -> list[Shape]:
        """Return shapes of the observation of an agent, if the agent was in this vehicle."""
        mine = frame.vehicles[frame.vehicles["id"] == vehicle]
        if kept is None or not len(mine) or int(mine["agent"][0]) != agent:
            return []
        shapes = observed_shapes(self._config, kept[agent])
        return [_rounded(shape) for shape in shapes if shape["kind"] in _DRAWN]


def _rounded(shape: Shape) -> Shape:
    """Round positions to decimetres, because a page has thousands of them."""
    names = {"rays": ("from", "ends"), "links": ("points",)}[shape["kind"]]
    return shape | {name: [round(value, 1) for value in shape[name]] for name in names}


def cause_of(trip: np.void) -> str:
    """Return the cause of a failed trip, one of `CAUSES`."""
    return next((cause for cause in FATES if trip[cause]), "slow")


def worst(failures: Iterable[Failure], most: int) -> list[Failure]:
    """Return up to `most` failures, the worst of each cause in turn, sorted by cause."""
    every = sorted(failures, key=lambda failure: -failure.severity)
    by_cause = {cause: [one for one in every if one.cause == cause] for cause in CAUSES}
    chosen: dict[str, int] = dict.fromkeys(CAUSES, 0)
    left = most
    while left > 0 and any(chosen[cause] < len(by_cause[cause]) for cause in CAUSES):
        for cause in CAUSES:
            if left > 0 and chosen[cause] < len(by_cause[cause]):
                chosen[cause] += 1
                left -= 1
    return [failure for cause in CAUSES for failure in by_cause[cause][: chosen[cause]]]


def clip_of(frames: Sequence[WorldFrame], center: tuple[float, float]) -> dict[str, Any]:
    """Return the vehicles near a place in some frames, as numbers for a page.

    Returns:
        `vehicles`: id → [length, width, agent]; `frames`: for each frame, the tick and a row [id,
            x, y, heading, speed, lights] per vehicle; lights: 1 brakes, 2 left, 4 right.
    """
    vehicles: dict[str, list[float]] = {}
    shown = []
    for frame in frames:
        rows = frame.vehicles
        near = (np.abs(rows["x"] - center[0]) < REACH_M) & (np.abs(rows["y"] - center[1]) < REACH_M)
        listed = []
        for row in rows[near]:
            size = [round(float(row["length"]), 2), round(float(row["width"]), 2)]
            vehicles[str(row["id"])] = [*size, int(row["agent"])]
            lights = int(row["accel"] < -1.0) + 2 * int(row["blinker"] > 0)
            lights += 4 * int(row["blinker"] < 0)
            moved = [round(float(row[name]), 2) for name in ("x", "y")]
            heading, speed = round(float(row["heading"]), 3), round(float(row["speed"]), 1)
            listed.append([int(row["id"]), *moved, heading, speed, lights])
        shown.append([frame.tick, listed])
    return {"vehicles": vehicles, "frames": shown}
