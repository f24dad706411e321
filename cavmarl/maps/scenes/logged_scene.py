"""`LoggedScene`: the lanes, the road edges and the tracks of a logged scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import MapError
from cavmarl.core.math.elementary_arrays import cos_all, sin_all

Numbers = NDArray[np.float64]

KINDS = ("vehicle", "pedestrian", "cyclist")
FASTEST_MPS = 60.0  # a faster move is a jump, at which a track is cut in two
FARTHEST_M = 1e7  # limit of all coordinates


class SceneLane(NamedTuple):
    """A lane of a scene.

    `points`: (n, 3) centre line in m, in the direction of travel. `speed_mps`: speed limit;
    None: not stated. `width_m`: None: not stated. `exits`: ids of the lanes that follow; None: not
    stated.
    """

    name: str
    points: Numbers
    is_freeway: bool
    speed_mps: float | None
    width_m: float | None
    exits: tuple[str, ...] | None


@dataclass(frozen=True, eq=False)
class Track:
    """The poses of one road user at all T times of a scene.

    Attributes:
        name: its id in the file; parts after a jump have the suffix `#2`, `#3` and so on.
        kind: one of `KINDS`.
        poses: (T, 3) x and y of the centre in m, and heading in rad, counter-clockwise from east.
        valid: (T,) whether the road user was seen.
        size_m: length, width and height: medians over the valid times.
    """

    name: str
    kind: str
    poses: Numbers
    valid: NDArray[np.bool_]
    size_m: tuple[float, float, float]

    @cached_property
    def times(self) -> NDArray[np.int64]:
        """The valid times, ascending."""
        return np.flatnonzero(self.valid)

    def pose_at(self, time: float) -> Numbers | None:
        """Return x, y and heading at a time in samples; None: not seen around that time.

        Between two samples, the position is interpolated linearly, and the heading over the
        shorter arc.
        """
        first = int(time)
        share = time - first
        if share < 1e-9 or first + 1 >= len(self.valid):
            return self.poses[first] if first < len(self.valid) and self.valid[first] else None
        if not (self.valid[first] and self.valid[first + 1]):
            return None
        before, after = self.poses[first], self.poses[first + 1]
        found: Numbers = before + share * (after - before)
        found[2] = before[2] + share * wrapped(after[2:] - before[2:])[0]
        return found


@dataclass(frozen=True, eq=False)
class LoggedScene:
    """A logged scene.

    Attributes:
        name: name in the file.
        step_s: time between two samples.
        lanes: lanes for motor vehicles.
        road_edges: polylines (n, 2) with the road on their left, in m.
        tracks: tracks of road users that are seen at least once, in the order of the file.
        own: name of the track of the vehicle that logged the scene; empty: unknown.
        present: number of the sample at which a prediction begins; 0: not stated.
        notes: omissions, cuts and guesses, with counts.
    """

    name: str
    step_s: float
    lanes: Sequence[SceneLane]
    road_edges: Sequence[Numbers]
    tracks: Sequence[Track]
    own: str
    present: int
    notes: tuple[str, ...]

    @property
    def num_times(self) -> int:
        """T, the number of samples."""
        return len(self.tracks[0].valid) if self.tracks else 0


def wrapped(angles: Numbers) -> Numbers:
    """Return angles in [-π, π)."""
    found: Numbers = (angles + np.pi) % (2.0 * np.pi) - np.pi
    return found


def checked_track(
    name: str,
    kind: str,
    poses: Numbers,
    valid: NDArray[np.bool_],
    sizes: Numbers,
) -> Track | None:
    """Return the track of one road user, or None if it is never seen.

    `sizes`: (T, 3) or (1, 3) length, width and height in m.

    Raises MapError: a valid pose or size is not finite or out of range.
    """
    if not valid.any():
        return None
    if len(sizes) == len(valid):
        sizes = sizes[valid]
    seen = poses[valid]
    if not (np.abs(seen) <= FARTHEST_M).all():
        raise MapError(
            f"track '{name[:80]}': a valid pose is not finite, or beyond {FARTHEST_M:g} m: correct "
            "it, or mark it as not valid"
        )
    size = np.median(sizes, axis=0)
    if not ((size > 0.0) & (size <= 100.0)).all():
        raise MapError(
            f"track '{name[:80]}': length, width and height are {size.tolist()}: must be above 0, "
            "and at most 100 m; correct them, or remove the track"
        )
    poses = np.where(valid[:, None], poses, 0.0)
    poses[:, 2] = wrapped(poses[:, 2])
    length, width, height = size.tolist()
    return Track(name, kind, poses, valid, (length, width, height))


def without_jumps(tracks: Sequence[Track], step_s: float) -> tuple[list[Track], int]:
    """Cut tracks where they jump. Return the tracks and the number of jumps."""
    found: list[Track] = []
    names = {track.name for track in tracks}
    jumps = 0
    for track in tracks:
        cuts = [0]
        for before, after in pairwise(track.times.tolist()):
            apart = track.poses[after, :2] - track.poses[before, :2]
            reach_m = FASTEST_MPS * step_s * (after - before)
            if apart[0] * apart[0] + apart[1] * apart[1] > reach_m * reach_m:
                cuts.append(after)
        jumps += len(cuts) - 1
        for number, (start, end) in enumerate(pairwise([*cuts, len(track.valid)])):
            valid = track.valid.copy()
            valid[:start] = valid[end:] = False
            name = track.name
            while number and (name == track.name or name in names):
                number += 1
                name = f"{track.name}#{number}"
            names.add(name)
            found.append(replace(track, name=name, valid=valid))
    return found, jumps


def count_overlaps(tracks: Sequence[Track]) -> int:
    """Return the number of pairs of tracks whose bodies overlap at some time."""
    if not tracks:
        return 0
    pairs: set[tuple[int, int]] = set()
    poses = np.stack([track.poses for track in tracks])
    valid = np.stack([track.valid for track in tracks])
    half = 0.5 * np.array([track.size_m[:2] for track in tracks])
    for time in range(valid.shape[1]):
        seen = np.flatnonzero(valid[:, time])
        found = boxes_meet(poses[seen, time], half[seen])
        one, other = np.nonzero(np.triu(found, 1))
        pairs.update(zip(seen[one].tolist(), seen[other].tolist(), strict=True))
    return len(pairs)


def boxes_meet(poses: Numbers, half: Numbers) -> NDArray[np.bool_]:
    """Return (n, n) which boxes overlap, by the separating axis theorem.

    `poses`: (n, 3) x, y and heading. `half`: (n, 2) half the length and the width.
    """
    heading = poses[:, 2]
    cos, sin = cos_all(heading), sin_all(heading)
    east = poses[None, :, 0] - poses[:, None, 0]
    north = poses[None, :, 1] - poses[:, None, 1]
    along = np.abs(east * cos[:, None] + north * sin[:, None])
    across = np.abs(north * cos[:, None] - east * sin[:, None])
    same = np.abs(cos[:, None] * cos[None, :] + sin[:, None] * sin[None, :])
    turned = np.abs(sin[:, None] * cos[None, :] - cos[:, None] * sin[None, :])
    length, width = half[:, 0], half[:, 1]
    apart = along > length[:, None] + length[None, :] * same + width[None, :] * turned
    apart |= across > width[:, None] + width[None, :] * same + length[None, :] * turned
    meets: NDArray[np.bool_] = ~(apart | apart.T)
    np.fill_diagonal(meets, False)
    return meets
