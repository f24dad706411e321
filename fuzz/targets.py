"""All targets by name: one for each kind of file that cavmarl reads, and for bytes from sockets."""

from __future__ import annotations

from fuzz.followers import FOLLOWER
from fuzz.protocol import LOGS, MESSAGES
from fuzz.roads import BUILDINGS, CACHED, MAPS, NETWORKS, PROGRAMS, ZONES
from fuzz.scenes import DOCUMENTS, PICKLES
from fuzz.settings import CHECKPOINTS, DRIVERS, ENTRIES, MANIFESTS, OVERRIDES, PLANS
from fuzz.traffic import DEMAND, SUMO_CONFIGS, TRACES

__all__ = ["TARGETS"]

TARGETS = {
    "network": NETWORKS,
    "programs": PROGRAMS,
    "buildings": BUILDINGS,
    "map": MAPS,
    "cached": CACHED,
    "zones": ZONES,
    "demand": DEMAND,
    "sumocfg": SUMO_CONFIGS,
    "trace": TRACES,
    "scene-pickle": PICKLES,
    "scene-json": DOCUMENTS,
    "entry": ENTRIES,
    "overrides": OVERRIDES,
    "driver": DRIVERS,
    "checkpoint": CHECKPOINTS,
    "manifest": MANIFESTS,
    "plan": PLANS,
    "message": MESSAGES,
    "log": LOGS,
    "follower": FOLLOWER,
}
