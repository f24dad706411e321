"""Load the kernels of worlds and libsumo on import, so that forks of the process have them."""

from __future__ import annotations

import contextlib

from cavmarl.engine.world_setup import load_world
from cavmarl.parallel.worlds.local_worlds import LocalWorlds

LocalWorlds(load_world("grid4x4", zones=4), 1, warm=True)

with contextlib.suppress(ImportError):  # the extra 'sumo'
    import libsumo  # noqa: F401
