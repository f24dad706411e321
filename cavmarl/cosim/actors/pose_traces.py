"""Recorded traces as actors: CSV files with poses, read once and played back in simulated time.

Traces use the same classes as the poses of a client: `ClientActors` and `PoseTrack`.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from cavmarl.core.errors import ConfigError, OccupiedPlaceError
from cavmarl.core.records.codes import CLASS_PEDESTRIAN
from cavmarl.cosim.actors.client_actors import MOST_NAME, ActorOrder, ClientActor, ClientActors
from cavmarl.cosim.actors.pose_track import MOST_RATE_HZ, PoseSample
from cavmarl.roads.network import VEHICLE_CLASSES

MOST_ROWS = 5_000_000
_NEEDED = ("time_s", "x", "y", "heading")
_OPTIONAL = ("z", "pitch", "speed", "received_s", "length", "width", "height")
_SOON_S = 1e-9
_SIZES = ("length", "width", "height")
# Types of the numbers in the column `vclass` of `cavmarl replay --csv`; the other classes are cars.
_TYPES = {
    VEHICLE_CLASSES.index("truck"): "truck",
    VEHICLE_CLASSES.index("bus"): "bus",
    VEHICLE_CLASSES.index("bicycle"): "cyclist",
    CLASS_PEDESTRIAN: "pedestrian",
}


@dataclass(frozen=True)
class PoseTrace:
    """The recorded poses of one body.

    Attributes:
        name: name of the body.
        vtype: its type; see `ActorOrder`.
        size_m: length, width and height; None: the type's size.
        samples: samples in the order of arrival; stamps count from the earliest time in the file.
        received_s: time at which each sample arrives; ascending.
    """

    name: str
    vtype: str
    size_m: tuple[float, float, float] | None
    samples: Sequence[PoseSample]
    received_s: Sequence[float]

    @property
    def rate_hz(self) -> float:
        """The rate of the samples: the inverse of the median time between two of them."""
        stamps = sorted(sample.stamp_s for sample in self.samples)
        spans = sorted(later - earlier for earlier, later in pairwise(stamps))
        spans = [span for span in spans if span > _SOON_S]
        return min(1.0 / spans[len(spans) // 2], MOST_RATE_HZ) if spans else 0.0


def read_traces(path: Path) -> list[PoseTrace]:
    """Read the traces of a CSV file, one per value of the column `id`.

    The columns `time_s`, `x`, `y` and `heading` are necessary. `z`, `pitch`, `speed`, `received_s`
    (time of arrival), `id`, `type` (or `vclass`), `length`, `width` and `height` are optional, and
    other columns are ignored. So files of `cavmarl replay --csv` can be read.

    Raises:
        ConfigError: the file cannot be read, a column is missing, or a value is not a number.
    """
    rows: dict[str, list[dict[str, str]]] = {}
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            missing = [name for name in _NEEDED if name not in (reader.fieldnames or ())]
            if missing:
                raise ConfigError(
                    f"{path}: no column {', '.join(missing)}; the columns {', '.join(_NEEDED)} are "
                    "necessary"
                )
            for number, row in enumerate(reader):
                if number >= MOST_ROWS:
                    raise ConfigError(f"{path}: has over {MOST_ROWS} rows; cut it into parts")
                rows.setdefault(row.get("id") or path.stem, []).append(row)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{path}: cannot be read ({error}); give a CSV file") from error
    if not rows:
        raise ConfigError(f"{path}: has no rows; give a file with poses")
    numbers = {name: [_numbers(path, row) for row in listed] for name, listed in rows.items()}
    start_s = min(row["time_s"] for listed in numbers.values() for row in listed)
    return [_trace(path, name, rows[name][0], listed, start_s) for name, listed in numbers.items()]


def _numbers(path: Path, row: Mapping[str, Any]) -> dict[str, float]:
    found = {}
    for name in (*_NEEDED, *_OPTIONAL):
        text = row.get(name)
        if not text:
            if name in _NEEDED:
                raise ConfigError(f"{path}: a row has no {name}; complete it, or remove the row")
            continue
        try:
            found[name] = float(text)
        except ValueError:
            found[name] = math.nan
        if not math.isfinite(found[name]):
            raise ConfigError(f"{path}: {name} = {text[:MOST_NAME]}: must be a finite number")
    return found


def _trace(
    path: Path,
    name: str,
    first: Mapping[str, Any],
    rows: Sequence[Mapping[str, float]],
    start_s: float,
) -> PoseTrace:
    """Return the trace of one body. `first`: its first row. `start_s`: start of the file."""
    listed = sorted(rows, key=lambda row: (row.get("received_s", row["time_s"]), row["time_s"]))
    samples = [
        PoseSample(
            row["time_s"] - start_s,
            row["x"],
            row["y"],
            row["heading"],
            row.get("z"),
            row.get("pitch"),
            row.get("speed"),
        )
        for row in listed
    ]
    arrivals = [row.get("received_s", row["time_s"]) - start_s for row in listed]
    early = [k for k, sample in enumerate(samples) if arrivals[k] < sample.stamp_s - _SOON_S]
    if early:
        raise ConfigError(
            f"{path}: a row of '{name}' has received_s before time_s; must be at least time_s"
        )
    body = rows[0]
    if missing := [key for key in _SIZES if key not in body]:
        if len(missing) < len(_SIZES):
            raise ConfigError(
                f"{path}: the first row of '{name}' has no {missing[0]}; give length, width and "
                "height, or none of them"
            )
    return PoseTrace(
        name,
        first.get("type") or _type_of(path, first.get("vclass")),
        None if missing else (body["length"], body["width"], body["height"]),
        samples,
        arrivals,
    )


def _type_of(path: Path, vclass: str | None) -> str:
    """Return the type of a class. Raises ConfigError: `vclass` is not the number of a class."""
    if not vclass:
        return "car"
    if vclass not in map(str, range(CLASS_PEDESTRIAN + 1)):
        raise ConfigError(
            f"{path}: vclass = {vclass[:MOST_NAME]}: must be from 0 to {CLASS_PEDESTRIAN}, as "
            "`cavmarl replay --csv` writes it; name types in the column type"
        )
    return _TYPES.get(int(vclass), "car")


@dataclass(eq=False)
class _Played:
    """A trace in an episode."""

    trace: PoseTrace
    next: int = 0  # first sample that has not arrived
    actor: ClientActor | None = None
    refused: int = 0  # steps with new poses in which the place of the newest was occupied


class TracePlayer:
    """Plays traces in an environment, in each episode from its start.

    A body enters in the step of its first pose; if the place is occupied, it enters with the first
    later pose whose place is free. It leaves after its last pose.

    Args:
        actors: the actors of the environment.
        traces: the traces.
        step_s: duration of a step.
        extrapolation_s: largest time for which a pose is extrapolated.
    """

    def __init__(
        self,
        actors: ClientActors,
        traces: Iterable[PoseTrace],
        step_s: float,
        extrapolation_s: float = 0.5,
    ) -> None:
        self._actors = actors
        self._step_s = step_s
        self._bound_s = extrapolation_s
        self._traces = tuple(traces)
        self._played: list[_Played] = []

    @property
    def refused(self) -> int:
        """Number of steps with new poses in which a body could not enter, in this episode."""
        return sum(one.refused for one in self._played)

    def begin_episode(self) -> None:
        """Play all traces from the start. Call it before the reset."""
        self._actors.part(one.actor for one in self._played if one.actor is not None)
        self._played = [_Played(trace) for trace in self._traces]

    def act(self, now_s: float) -> None:
        """Hand over the poses that have arrived by the end of the next step.

        Raises:
            CavmarlError: the world has no room for external vehicles, or refuses a body or a pose
                for another reason than an occupied place.
        """
        end_s = now_s + self._step_s
        for one in self._played:
            trace, first = one.trace, one.next
            while one.next < len(trace.samples) and trace.received_s[one.next] <= end_s + _SOON_S:
                one.next += 1
            arrived = trace.samples[first : one.next]
            if one.actor is None and arrived:
                one.actor = self._enter(one, max(arrived, key=lambda sample: sample.stamp_s))
            if one.actor is not None:
                for sample in arrived:
                    self._actors.add_pose(one.actor, sample, now_s)
                if one.next == len(trace.samples) and not arrived:
                    self._actors.part([one.actor])
                    one.actor = None

    def _enter(self, one: _Played, pose: PoseSample) -> ClientActor | None:
        trace = one.trace
        order = ActorOrder(
            name=trace.name,
            vtype=trace.vtype,
            x=pose.x,
            y=pose.y,
            heading=pose.heading,
            z=pose.z,
            size_m=trace.size_m,
            speed=pose.speed or 0.0,
            rate_hz=trace.rate_hz,
            extrapolation_s=self._bound_s,
        )
        try:
            return self._actors.join("trace", [order])[0]
        except OccupiedPlaceError:
            one.refused += 1
            return None
