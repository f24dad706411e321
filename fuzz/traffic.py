"""Targets for demand: routes and types, and SUMO's configurations."""

from __future__ import annotations

from contextlib import suppress

from cavmarl.core.errors import CavmarlError
from cavmarl.traffic.demand import read_demand
from cavmarl.traffic.demand.sumo_config import read_sumo_config
from cavmarl.traffic.schedule import Schedule
from cavmarl.traffic.sumo.sumo_input import read_input
from fuzz.files import Target, scratch, seed
from fuzz.roads import grid

__all__ = ["DEMAND", "SUMO_CONFIGS"]

MAX_DEPARTURES = 2000


def _demand(content: bytes) -> None:
    path = scratch("x.rou.xml", content)
    with suppress(CavmarlError):
        read_demand([path], grid(), on_bad_route="skip", max_departures=MAX_DEPARTURES)
    demand = read_demand([path], grid(), max_departures=MAX_DEPARTURES)
    Schedule(demand, 0, 0).draw(1, 60.0, 0.1)


def _sumo_config(content: bytes) -> None:
    path = scratch("x.sumocfg", content)
    for name in ("map.net.xml", "a.rou.xml", "b.rou.xml", "c.add.xml", "d.add.xml"):
        scratch(name, b"<additional/>")
    with suppress(CavmarlError):
        read_input([path])
    read_sumo_config(path)


DEMAND = Target(_demand, lambda: (seed("demand.rou.xml"),))
SUMO_CONFIGS = Target(_sumo_config, lambda: (seed("small.sumocfg"),))
