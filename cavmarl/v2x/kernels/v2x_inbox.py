"""An inbox: the nearest subjects that a receiver knows, each with its newest report."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import kernel


@kernel
def empty(box: NDArray[np.void], first: int) -> None:
    """Remove all reports at indices `first` and above."""
    for k in range(first, box.size):
        report = box[k]
        report["subject"] = -1
        report["sender"] = -1


@kernel
def forget(box: NDArray[np.void], tick: int) -> int:
    """Remove expired reports and move the others to the front; return their number."""
    num = 0
    for k in range(box.size):
        if box[k]["sender"] < 0:
            break
        if box[k]["expires"] >= tick:
            if num < k:
                box[num] = box[k]
            num += 1
    return num


@kernel
def find(box: NDArray[np.void], num: int, subject: int) -> int:
    """Return the index of a subject's report in the inbox, or -1."""
    for k in range(num):
        if box[k]["subject"] == subject:
            return k
    return -1


@kernel
def is_better(report: np.void, other: np.void) -> bool:
    """Return whether a report replaces another report of a subject: the newer report wins.

    Among reports of one tick, the subject's own report wins, then the lowest sender id.
    """
    if report["tick"] != other["tick"]:
        return bool(report["tick"] > other["tick"])
    if report["kind"] != other["kind"]:
        return bool(report["kind"] < other["kind"])
    return bool(report["sender"] < other["sender"])


@kernel
def _squared(report: np.void, x: float, y: float) -> float:
    dx = report["x"] - x
    dy = report["y"] - y
    return float(dx * dx + dy * dy)


@kernel
def sort_by_distance(
    box: NDArray[np.void], num: int, squared: NDArray[np.float64], x: float, y: float
) -> None:
    """Sort the first `num` reports by distance, then by subject.

    `box`: REPORT (N,). `squared`: (at least N,) squared distances of the reports from (x, y) in m²,
    overwritten.
    """
    is_sorted = True
    for k in range(num):
        squared[k] = _squared(box[k], x, y)
        if k > 0 and not _is_before(squared, box, k - 1, squared[k], box[k]["subject"]):
            is_sorted = False
    if is_sorted:
        return
    # Insertion sort, because the order of the last tick is nearly right.
    for k in range(1, num):
        place = k
        while place > 0 and not _is_before(
            squared, box, place - 1, squared[place], box[place]["subject"]
        ):
            _swap(box, squared, place)
            place -= 1


@kernel
def _is_before(
    squared: NDArray[np.float64], box: NDArray[np.void], k: int, other: float, subject: int
) -> bool:
    is_nearer = squared[k] < other
    return bool(is_nearer or (squared[k] == other and box[k]["subject"] < subject))


@kernel
def _swap(box: NDArray[np.void], squared: NDArray[np.float64], place: int) -> None:
    """Swap a report with the previous report."""
    a = box[place - 1]
    b = box[place]
    a["subject"], b["subject"] = b["subject"], a["subject"]
    a["sender"], b["sender"] = b["sender"], a["sender"]
    a["tick"], b["tick"] = b["tick"], a["tick"]
    a["expires"], b["expires"] = b["expires"], a["expires"]
    a["kind"], b["kind"] = b["kind"], a["kind"]
    a["code"], b["code"] = b["code"], a["code"]
    a["x"], b["x"] = b["x"], a["x"]
    a["y"], b["y"] = b["y"], a["y"]
    a["z"], b["z"] = b["z"], a["z"]
    a["heading"], b["heading"] = b["heading"], a["heading"]
    a["speed"], b["speed"] = b["speed"], a["speed"]
    a["accel"], b["accel"] = b["accel"], a["accel"]
    a["yaw_rate"], b["yaw_rate"] = b["yaw_rate"], a["yaw_rate"]
    a["length"], b["length"] = b["length"], a["length"]
    a["width"], b["width"] = b["width"], a["width"]
    a["left_s"], b["left_s"] = b["left_s"], a["left_s"]
    squared[place - 1], squared[place] = squared[place], squared[place - 1]


@kernel
def insert(
    box: NDArray[np.void],
    num: int,
    squared: NDArray[np.float64],
    report: np.void,
    x: float,
    y: float,
) -> int:
    """Insert a report of a new subject by distance, if near enough; return the new number.

    `box`: REPORT (N,), sorted. `squared`: squared distances of the reports, in m². `report`: a
    report of a subject that is not in the box. `x`, `y`: position of the receiver, m.
    """
    distance = _squared(report, x, y)
    place = num
    while place > 0 and not _is_before(squared, box, place - 1, distance, report["subject"]):
        place -= 1
    if place == box.size:
        return num
    num = min(num + 1, box.size)
    for k in range(num - 1, place, -1):
        box[k] = box[k - 1]
        squared[k] = squared[k - 1]
    box[place] = report
    squared[place] = distance
    return num
