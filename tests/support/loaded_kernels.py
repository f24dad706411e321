"""Loads the kernels of worlds when it is imported, for processes that are forked later."""

from __future__ import annotations

from cavmarl.engine.world_setup import load_world
from cavmarl.parallel.worlds.local_worlds import LocalWorlds

LocalWorlds(load_world("grid4x4", zones=4), 1, warm=True)
