"""Targets for demand and traces: routes and types, SUMO's configurations, recorded poses."""

from __future__ import annotations

from contextlib import suppress

from cavmarl.core.errors import CavmarlError
from cavmarl.cosim.actors.pose_traces import read_traces
from cavmarl.cosim.actors.pose_track import PoseTrack
from cavmarl.traffic.demand import read_demand
from cavmarl.traffic.demand.sumo_config import read_sumo_config
from cavmarl.traffic.schedule import Schedule
from cavmarl.traffic.sumo.sumo_input import read_input
from fuzz.files import Target, scratch, seed
from fuzz.roads import grid

__all__ = ["DEMAND", "SUMO_CONFIGS", "TRACES"]

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


def _traces(content: bytes) -> None:
    for trace in read_traces(scratch("x.csv", content)):
        track = PoseTrack(trace.rate_hz, 0.5)
        for sample, now_s in zip(trace.samples, trace.received_s, strict=True):
            track.add(sample, now_s, 0.05)
            track.at(now_s + 0.05)


def _trace_files() -> tuple[bytes, ...]:
    small = b"time_s,x,y,heading\n0.0,1.5,2,0\n0.02,1.6,2,0.1\n"
    full = (
        b"id,type,time_s,x,y,heading,z,pitch,speed,received_s,length,width,height\n"
        b"a,truck,3,1,2,0,0.1,0.02,9,3.1,6,2,3\nb,,3.1,1,9,-3,,,,,,,\na,truck,3.2,3,2,0,,,,3.3,,,\n"
    )
    recorded = b"tick,time_s,id,x,y,heading,length,width,height,vclass\n1,0.05,7,1,2,0,1.6,1,1,8\n"
    return small, full, recorded


TRACES = Target(_traces, _trace_files)
DEMAND = Target(_demand, lambda: (seed("demand.rou.xml"),))
SUMO_CONFIGS = Target(_sumo_config, lambda: (seed("small.sumocfg"),))
