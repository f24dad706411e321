"""Loops that run a phase of a tick in several zones of one process, as one call.

A call passes about sixty arrays from Python, which takes longer than the work in a small zone.
`for_each_zone` therefore makes a kernel that calls the kernel of one zone for each zone in turn.
The result of a zone does not depend on the other zones of the call.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled import inlined_kernel, kernel
from cavmarl.core.math.neighbors import Grid
from cavmarl.core.records.arrays import SharedState, Worlds, ZoneState
from cavmarl.zones.kernels.zone_lookup import Halo, ZoneArrays

FRAME = np.dtype(
    [
        ("corner_x", np.float64),  # see `neighbors.Grid`
        ("corner_y", np.float64),
        ("cells_per_m", np.float64),
        ("num_x", np.int64),
        ("num_y", np.int64),
    ],
    align=True,
)
COMMITTED, NEXT = 0, 1  # items of `Members.sides`


class Members(NamedTuple):
    """The zones in which a call runs a phase."""

    numbers: NDArray[np.int64]  # (n,) the numbers of the zones, ascending
    frames: NDArray[np.void]  # FRAME (n,) of the spatial index of each zone
    sides: NDArray[np.int64]  # (2,) the halves of `ZoneState.rows` with committed and next rows
    zones: ZoneArrays  # the partition
    halo: Halo
    zoned: ZoneState
    common: SharedState
    grid: Grid  # scratch memory, large enough for the largest zone


@inlined_kernel
def worlds_of(members: Members, zone: int) -> Worlds:
    """Return a zone's part of all worlds."""
    zoned = members.zoned
    common = members.common
    return Worlds(
        rows=zoned.rows[members.sides[COMMITTED], zone],
        next_rows=zoned.rows[members.sides[NEXT], zone],
        num_owned=zoned.num_owned[zone],
        num_rows=zoned.num_rows[zone],
        ticks=common.ticks,
        keys=common.keys,
        signal_phase=common.signal_phase,
        controllers=common.controllers,
        detected_s=common.detected_s,
        num_through=zoned.num_through[zone],
        pending=common.pending,
        num_near=zoned.num_near[zone],
        num_touching=zoned.num_touching[zone],
        num_contacts=zoned.num_contacts[zone],
        step=zoned.step[zone],
        step_at=zoned.step_at[zone],
        outer=zoned.outer[zone],
        num_outer=zoned.num_outer[zone],
        cues=common.cues,
        lanes=common.lanes,
    )


@inlined_kernel
def grid_of(members: Members, n: int) -> Grid:
    """Return the spatial index of the n-th zone, in the scratch memory that all zones share."""
    frame = members.frames[n]
    shared = members.grid
    cells = frame["num_x"] * frame["num_y"]
    shared.corner[0] = frame["corner_x"]
    shared.corner[1] = frame["corner_y"]
    return Grid(
        corner=shared.corner,
        floating=shared.floating,
        cells_per_m=frame["cells_per_m"],
        num_x=frame["num_x"],
        num_y=frame["num_y"],
        start=shared.start[: cells + 1],
        bodies=shared.bodies,
        cell=shared.cell,
        largest=shared.largest,
        newest=shared.newest[:cells],
        spots=shared.spots,
    )


# `for_each_zone` passes arguments for parameters of these names; callers pass all other arguments.
_OF_ZONE = {
    "worlds": "worlds",
    "rows": "worlds.rows",
    "num_owned": "worlds.num_owned",
    "ticks": "worlds.ticks",
    "detected_s": "worlds.detected_s",
    "grid": "grid_of(members, n)",
    "zone": "zone",
    "zones": "members.zones",
    "halo": "members.halo",
    "inner": "members.halo.inner[zone]",
    "zoned": "members.zoned",
    "next_side": f"members.sides[{NEXT}]",
    "in_place": f"members.sides[{COMMITTED}] == members.sides[{NEXT}]",
}


def for_each_zone(phase: Callable[..., object]) -> Callable[..., None]:
    """Return a kernel `NAME_each(members, ...)` that calls the kernel `phase` in each zone.

    For each zone, the returned kernel fills in parameters of `phase` that are named in `_OF_ZONE`.
    The other parameters follow `members` in its signature, with the same names.
    """
    names = list(inspect.signature(phase).parameters)
    given = [name for name in names if name not in _OF_ZONE]
    filled = [_OF_ZONE.get(name, name) for name in names]
    name = f"{phase.__name__}_each"
    source = (
        f"def {name}({', '.join(['members', *given])}):\n"
        "    for n in range(members.numbers.size):\n"
        "        zone = members.numbers[n]\n"
        "        worlds = worlds_of(members, zone)\n"
        f"        phase({', '.join(filled)})\n"
    )
    module = inspect.stack()[1].frame.f_globals["__name__"]
    scope: dict[str, Any] = {"phase": phase, "worlds_of": worlds_of, "grid_of": grid_of}
    exec(compile(source, f"<{module}.{name}>", "exec"), scope)
    made: Any = scope[name]
    made.__module__, made.__doc__ = module, phase.__doc__
    return kernel(made)
