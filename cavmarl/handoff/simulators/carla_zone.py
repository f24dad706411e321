"""`CarlaZone`: a zone that a CARLA server runs, by the official client in a process of its own."""

from __future__ import annotations

import json
import math
import os
import re
import selectors
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import ConfigError, ZoneSimulatorError
from cavmarl.handoff.simulators import carla_frames, carla_zone_client
from cavmarl.handoff.simulators.zone_simulator import MOTION, ZoneSetup, number_option

PYTHON = "CAVMARL_CARLA_PYTHON"  # environment variable: the Python that has CARLA's client
TOLERANCE_M = 2.0
GHOSTS_M = 60.0
TIMEOUT_S = 30.0
MOST_TIMEOUT_S = 3600.0
MOST_GHOSTS_M = 10_000.0
GRACE_S = 5.0  # additional time, so that the client can report its own timeout first
_END_S = 5.0  # time for the process to end by itself
_LAST_WORDS = 500
_CHECKED_LANES = 20
_FIELDS = ("id", "x", "y", "z", "heading", "speed", "length", "width", "agent")
_PLACE = re.compile(r"(?P<host>[A-Za-z0-9.-]+|\[[0-9A-Fa-f:]+\]):(?P<port>[0-9]{1,5})")
_OPTIONS = {"frames", "ghosts_m", "timeout_s", "tolerance_m"}


def check(place: str, options: Mapping[str, str]) -> None:
    """Check the address and the options of a CARLA server. Raises ConfigError."""
    found = _PLACE.fullmatch(place)
    if found is None or not 1 <= int(found["port"]) <= 65535:
        raise ConfigError(
            f"zones.simulators: 'carla://{place}' is not an address; use carla://HOST:PORT"
        )
    if unknown := sorted(options.keys() - _OPTIONS):
        raise ConfigError(
            f"zones.simulators: carla has no option {unknown[0]!r}; it has "
            f"{', '.join(sorted(_OPTIONS))}"
        )
    number_option(options, "timeout_s", TIMEOUT_S, MOST_TIMEOUT_S)
    number_option(options, "ghosts_m", GHOSTS_M, MOST_GHOSTS_M)
    carla_frames.check_option(options)


class CarlaZone:
    """A `ZoneSimulator` over CARLA's official client.

    Attributes:
        pid: id of the client's process.
        frame_types: types of sensors whose samples CARLA takes.
    """

    def __init__(self, setup: ZoneSetup) -> None:
        found = _PLACE.fullmatch(setup.place)
        assert found is not None  # `check` has accepted it
        self._setup = setup
        self._signals = setup.network.signal_ids
        self._timeout_s = number_option(setup.options, "timeout_s", TIMEOUT_S, MOST_TIMEOUT_S)
        self._ghosts_m = number_option(setup.options, "ghosts_m", GHOSTS_M, MOST_GHOSTS_M)
        gives_frames = carla_frames.gives_frames(setup.options)
        self.frame_types = frozenset(carla_frames.BLUEPRINTS if gives_frames else ())
        self._output = tempfile.TemporaryFile()
        python = os.environ.get(PYTHON) or sys.executable
        try:
            self._process = subprocess.Popen(
                [python, str(Path(carla_zone_client.__file__))],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._output,
            )
        except OSError as error:
            self._output.close()
            raise self._failure(f"{python} cannot be started ({error.strerror})") from error
        self.pid = self._process.pid
        self._rest = b""
        self._unread = 0  # number of outstanding answers; more than one after an interrupt
        try:
            self._call(
                "start",
                host=found["host"].strip("[]"),
                port=int(found["port"]),
                timeout_s=self._timeout_s,
                dt=setup.dt_s,
                places=self._places(),
                mounts=carla_frames.mounts_of(setup.rig, setup.dt_s) if gives_frames else {},
            )
        except BaseException:
            self._end()
            raise

    def _places(self) -> list[tuple[float, float, float]]:
        """Return the middle points of some lanes of the map."""
        network = self._setup.network
        lanes = np.flatnonzero(~network.lanes["internal"].astype(np.bool_))
        some = lanes[:: max(1, len(lanes) // _CHECKED_LANES)]
        found = (network.pose_on(lane, 0.5 * network.lanes["length_m"][lane]) for lane in some)
        return [(float(x), float(y), float(z)) for x, y, z, *_ in found]

    def prepare(self, vehicles: NDArray[np.void]) -> Mapping[int, str]:
        refused: dict[str, str] = self._call("prepare", rows=_rows(vehicles))
        return {int(vehicle): reason for vehicle, reason in refused.items()}

    def spawn(self, vehicles: NDArray[np.void]) -> None:
        if len(vehicles):
            self._call("spawn", rows=_rows(vehicles))

    def drop(self, vehicles: Sequence[int]) -> None:
        self._call("drop", vehicles=list(vehicles))

    def show(self, ghosts: NDArray[np.void], signals: Sequence[str]) -> None:
        # The OpenDRIVE export names the signal of a movement by signal id and index: `ID_INDEX`.
        letters = {
            f"{name}_{index}": letter
            for name, state in zip(self._signals, signals, strict=True)
            for index, letter in enumerate(state)
        }
        # Only ghosts near the zone are shown: drivers see farther than CARLA needs to show.
        min_x, min_y, max_x, max_y = self._setup.rect
        x, y = ghosts["x"], ghosts["y"]
        dx = np.maximum(np.maximum(min_x - x, x - max_x), 0.0)
        dy = np.maximum(np.maximum(min_y - y, y - max_y), 0.0)
        near = dx * dx + dy * dy <= self._ghosts_m * self._ghosts_m
        self._call("show", ghosts=_rows(ghosts[near]), signals=letters)

    def advance(self, wanted: NDArray[np.void], aims: NDArray[np.float64]) -> None:
        points = [None if math.isnan(point[0]) else point for point in aims.tolist()]
        self._send("advance", wanted=_rows(wanted), aims=points)

    def read(self) -> NDArray[np.void]:
        found = np.zeros(0, dtype=MOTION)
        rows = self._receive("advance")
        if rows:
            found = np.array([tuple(row) for row in rows], dtype=MOTION)
        return found

    def sense(self, sensor: str, vehicles: Sequence[int]) -> Mapping[int, NDArray[Any]]:
        config = self._setup.rig[sensor]
        found: dict[str, str] = self._call("sense", sensor=sensor, vehicles=list(vehicles))
        return {int(v): carla_frames.sample_of(config, frame) for v, frame in found.items()}

    def close(self) -> None:
        """Remove all actors, and end the client's process."""
        with suppress(ZoneSimulatorError):
            if self._process.poll() is None:
                self._send("close")
                self._line(time.monotonic() + _END_S)
        self._end()

    def _end(self) -> None:
        process = self._process
        with suppress(OSError):
            if process.stdin is not None:
                process.stdin.close()
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()
        self._output.close()

    def _call(self, kind: str, **content: Any) -> Any:
        self._send(kind, **content)
        return self._receive(kind)

    def _send(self, kind: str, **content: Any) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps({"do": kind, **content}).encode() + b"\n")
            self._process.stdin.flush()
            self._unread += 1
        except (OSError, ValueError) as error:
            raise self._failure(f"its client has ended ({self._last_words()})") from error

    def _receive(self, kind: str) -> Any:
        line = self._line(time.monotonic() + self._timeout_s + GRACE_S)
        try:
            answer: dict[str, Any] = dict(json.loads(line))
        except ValueError as error:
            self._process.kill()
            raise self._failure(f"its client has sent {line[:80]!r}, not an answer") from error
        if "error" in answer:
            advice = ""
            if "No module named 'carla'" in answer["error"]:
                advice = f"; install the package carla, or set {PYTHON} to a Python that has it"
            raise self._failure(f"{kind}: {answer['error']}{advice}")
        return answer["result"]

    def _line(self, until_s: float) -> bytes:
        """Wait for all outstanding answers; return the last answer."""
        line = b""
        while self._unread:
            line = self._next_line(until_s)
            self._unread -= 1
        return line

    def _next_line(self, until_s: float) -> bytes:
        pipe = self._process.stdout
        assert pipe is not None
        with selectors.DefaultSelector() as selector:
            selector.register(pipe, selectors.EVENT_READ)
            while b"\n" not in self._rest:
                left_s = until_s - time.monotonic()
                if left_s <= 0.0 or not selector.select(left_s):
                    self._process.kill()
                    raise self._failure(
                        f"its client has not answered in time (timeout_s = {self._timeout_s:g})"
                    )
                data = os.read(pipe.fileno(), 1 << 16)
                if not data:
                    self._process.wait()
                    raise self._failure(f"its client has ended ({self._last_words()})")
                self._rest += data
        line, _, self._rest = self._rest.partition(b"\n")
        return line

    def _last_words(self) -> str:
        self._output.seek(0)
        text = self._output.read().decode(errors="replace").strip()[-_LAST_WORDS:]
        return f"exit code {self._process.poll()}" + (f": {text}" if text else "")

    def _failure(self, what: str) -> ZoneSimulatorError:
        return ZoneSimulatorError(
            f"zone {self._setup.zone}: carla://{self._setup.place}: {what}", self._setup.zone
        )


def make(setup: ZoneSetup) -> CarlaZone:
    """Connect to the CARLA server of a zone."""
    return CarlaZone(setup)


def _rows(vehicles: NDArray[np.void]) -> list[list[float]]:
    """Return the fields of vehicles that the client needs, in the order of `_FIELDS`."""
    return [list(row) for row in zip(*(vehicles[name].tolist() for name in _FIELDS), strict=True)]
