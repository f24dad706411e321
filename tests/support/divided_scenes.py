"""Vehicles at chosen positions at a crossing, compared in one zone and in four zones."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.roads.sumo_net.reader import read_network
from cavmarl.zones.partition.zone_file import write_zones
from cavmarl.zones.partition.zone_partition import ZonePartition
from tests.support.demand_worlds import make
from tests.support.driving import drive, start
from tests.support.junction_scenes import ARM_M, NODES
from tests.support.traffic import on_lane

CLASSES = {"car": "passenger", "bus": "bus"}
MARGIN_M = 20.0  # margin of the zones around the ends of the arms
TICK_S = 0.05
# The vehicles of the demand file depart after the scene. They only define types and routes.
LATE_S = 900
CLOCK = {"clock.sim_dt_s": TICK_S, "clock.ctrl_dt_s": TICK_S, "horizon_s": 1000.0}
# With few ticks, a zone sees only vehicles near enough to touch, and vehicles that drivers watch.
CLOCK |= {"zones.approach_ticks": 2}


class DividedScene:
    """The same vehicles in one zone, and in four zones that meet at `corner_m` from the crossing.

    `departs`: lines of the demand file for vehicles that depart during the scene, by name.
    """

    def __init__(
        self,
        path: Path,
        folder: Path,
        corner_m: tuple[float, float],
        kinds: tuple[str, ...],
        departs: Mapping[str, str] = {},
    ) -> None:
        demand = folder / "late.rou.xml"
        edges = read_network(path).edge_ids
        demand.write_text(
            "<routes>"
            + "".join(f'<vType id="{kind}" vClass="{CLASSES[kind]}" sigma="0"/>' for kind in kinds)
            + "".join(
                f'<vehicle id="{kind}{a}{b}" type="{kind}" depart="{LATE_S}">'
                f'<route edges="{a}_in {b}_out"/></vehicle>'
                for kind in kinds
                for a in NODES
                for b in NODES
                if a != b and f"{b}_out" in edges
            )
            + "".join(departs.values())
            + "</routes>"
        )
        self.kinds = ("generated", *kinds)  # by index of VEHICLE_TYPE
        x, y = (ARM_M + middle for middle in corner_m)
        low, high = -MARGIN_M, 2.0 * ARM_M + MARGIN_M
        rects = [[low, low, x, y], [x, low, high, y], [low, y, x, high], [x, y, high, high]]
        layout = folder / "four.json"
        write_zones(layout, ZonePartition((low, low, high, high), np.array(rects)))
        four = {"zones.count": 4, "zones.layout": str(layout)}
        self.whole, self.divided = (
            make(path, [demand], overrides=CLOCK | zones) for zones in ({}, four)
        )
        for simulation in (self.whole, self.divided):
            start(simulation, seed=0)
        self.rows: list[NDArray[np.void]] = []
        self.names: list[str] = []
        self.departs = list(departs)

    def put(self, name: str, way: str, front_m: float, kind: str = "car", **fields: Any) -> None:
        """Put a vehicle on a route like "W_in_0 N_out_0", its front `front_m` beyond the line."""
        network, plans = self.whole.network, self.whole.plans
        travel = self.whole.travel
        before, after = (network.lane_ids.index(lane) for lane in way.split())
        links = network.links
        (link,) = np.flatnonzero((links["from_lane"] == before) & (links["to_lane"] == after))
        goal = int(np.flatnonzero(plans["link"][:, before] == link)[0])
        vtype = self.kinds.index(kind)
        length, width = (float(travel.types[vtype][field]) for field in ("length", "width"))
        lane, place = before, float(network.lanes["length_m"][before]) + front_m - 0.5 * length
        while place >= network.lanes["length_m"][lane]:
            place -= float(network.lanes["length_m"][lane])
            lane = int(plans["next"][goal, lane])
            fields = fields | {"link": link}
        row = on_lane(
            network, lane, place, travel, goal=goal, vtype=vtype, length=length, width=width,
            id=len(self.rows), **fields,
        )  # fmt: skip
        row["to_go"] = plans[goal, lane]["to_go"] - place
        self.rows.append(row)
        self.names.append(name)

    def begin(self) -> None:
        """Copy the vehicles into both worlds."""
        rows = np.concatenate(self.rows)
        self.names += self.departs
        for simulation in (self.whole, self.divided):
            simulation.departures.next_id[0] = len(rows)
            saved = [array.copy() for array in simulation.save()]
            zones = simulation.division.count
            saved[-zones - 2][...] = (
                0  # clear the saved ownership, which does not know these vehicles
            )
            saved[-zones:] = [rows, *(rows[:0] for _ in range(1, zones))]
            simulation.load(saved)

    def run(self, seconds: float) -> Iterator[dict[str, np.void]]:
        """Run both worlds, compare them, and yield the vehicles by name after each tick."""
        for tick in range(round(seconds / TICK_S)):
            for simulation in (self.whole, self.divided):
                drive(simulation)
            assert self.divided.state_hash() == self.whole.state_hash(), f"tick {tick}"
            vehicles = self.whole.vehicles()
            assert (vehicles["hit"] < 0).all(), "vehicles collide"
            yield {self.names[row["id"]]: row for row in vehicles}

    def ghosts(self, name: str) -> set[str]:
        """Return the names of the ghosts in the zone that owns a vehicle."""
        division, own = self.divided.division, self.names.index(name)
        for zone in range(division.count):
            worlds = division._shards[zone].worlds
            owned, rows = int(worlds.num_owned[0]), worlds.rows[0, : worlds.num_rows[0]]
            if own in rows["id"][:owned]:
                return {self.names[number] for number in rows["id"][owned:]}
        raise KeyError(name)
