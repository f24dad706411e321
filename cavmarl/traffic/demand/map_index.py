"""`MapIndex`: edges, lanes and connections of a map, by the names in demand files."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import CavmarlError, RouteError
from cavmarl.roads.network import VEHICLE_CLASSES, RoadNetwork
from cavmarl.traffic.demand.element import Element, near


class MapIndex:
    """Edges, lanes and connections of one map.

    Attributes:
        network: the roads.
        edge_row: EDGE row by id, without edges inside junctions.
        lane_row: LANE row by id.
        lane_table: (num_edges, n) LANE row by SUMO's index on the edge, -1 if there is none;
            SUMO also counts pavements.
        permissions: (num_edges,) classes that may use at least one lane of the edge.
    """

    def __init__(self, network: RoadNetwork) -> None:
        self.network = network
        self.edge_row = {
            name: row for row, name in enumerate(network.edge_ids) if not name.startswith(":")
        }
        self.lane_row = {name: row for row, name in enumerate(network.lane_ids)}
        position = [int(name.rpartition("_")[2]) for name in network.lane_ids]
        self.lane_table = np.full(
            (len(network.edges), max(position, default=0) + 1), -1, dtype=np.int32
        )
        self.lane_table[network.lanes["edge"], position] = np.arange(len(position))
        self.lane_table.setflags(write=False)
        self.permissions = np.zeros(len(network.edges), dtype=np.uint32)
        np.bitwise_or.at(self.permissions, network.lanes["edge"], network.lanes["permissions"])
        self._movements = self._connections()

    def _connections(self) -> dict[tuple[int, int], int]:
        """Return the classes that may drive directly from one edge to another."""
        lanes, links = self.network.lanes, self.network.links
        allowed = lanes["permissions"][links["from_lane"]] & lanes["permissions"][links["to_lane"]]
        pairs = zip(
            lanes["edge"][links["from_lane"]].tolist(),
            lanes["edge"][links["to_lane"]].tolist(),
            allowed.tolist(),
            strict=True,
        )
        found: dict[tuple[int, int], int] = {}
        for source, target, classes in pairs:
            found[source, target] = found.get((source, target), 0) | classes
        return found

    def edge(self, name: str, element: Element) -> int:
        """Return the EDGE row of an id.

        Raises DemandError: the map has no such edge.
        """
        row = self.edge_row.get(name, -1)
        if row < 0:
            raise element.error(
                f"names the edge '{name}', but the map '{self.network.name}' has no such edge for "
                "road vehicles",
                f"use files that were made for this map; {near(name, self.edge_row)}",
            )
        return row

    def edges(self, text: str, element: Element) -> tuple[int, ...]:
        """Return the EDGE rows of ids separated by blanks.

        Raises:
            DemandError: the map lacks an edge; if it lacks most edges, the file is for another map.
        """
        names = text.split()
        unknown = [name for name in names if name not in self.edge_row]
        if len(unknown) * 2 > len(names) > 1:
            some = ", ".join(list(self.edge_row)[:5])
            raise element.error(
                f"names {len(names)} edges, but the map '{self.network.name}' has only "
                f"{len(names) - len(unknown)} of them",
                f"use files that were made for this map; its edges are named {some} …",
            )
        return tuple(self.edge(name, element) for name in names)

    def lane(self, name: str, element: Element) -> int:
        """Return the LANE row of an id.

        Raises DemandError: the map has no such lane.
        """
        row = self.lane_row.get(name, -1)
        if row < 0 or name.startswith(":"):
            raise element.error(
                f"names the lane '{name}', but the map '{self.network.name}' has no such lane for "
                "road vehicles",
                near(name, [known for known in self.lane_row if not known.startswith(":")]),
            )
        return row

    def open_lane(self, edge: int, permissions: int) -> int:
        """Return the lane nearest to the kerb that a class may use, or else the first lane."""
        row = self.network.edges[edge]
        lanes = self.network.lanes[row["first_lane"] : row["first_lane"] + row["num_lanes"]]
        return int(row["first_lane"]) + int(np.argmax(lanes["permissions"] & permissions != 0))

    def scale(self, lane: int) -> float:
        """Return metres along this lane's polyline per metre of SUMO's lane length."""
        row = self.network.lanes[lane]
        return float(row["length_m"]) / float(self.network.edges[row["edge"]]["length_m"])

    def gap(
        self, edges: NDArray[np.int32] | tuple[int, ...], exact: bool, permissions: int
    ) -> str | None:
        """Return the reason why a class cannot follow a sequence of edges, or None if it can.

        `exact`: whether each edge must lead directly to the next. `permissions`: bits of the class.
        """
        names = self.network.edge_ids
        rows = [int(edge) for edge in edges]
        for row in dict.fromkeys(rows):
            if not int(self.permissions[row]) & permissions:
                return f"edge '{names[row]}' is forbidden for {_names(permissions)}"
        if exact:
            for source, target in pairwise(rows):
                if not self._movements.get((source, target), 0) & permissions:
                    way = (
                        "no connection"
                        if (source, target) not in self._movements
                        else (f"no connection for {_names(permissions)}")
                    )
                    return f"there is {way} from edge '{names[source]}' to '{names[target]}'"
        return None

    def route_error(self, element: Element, gap: str) -> CavmarlError:
        return element.error(
            f"cannot be driven: {gap}",
            "repair the route (duarouter --repair), or set traffic.on_bad_route = skip",
            RouteError,
        )


def _names(permissions: int) -> str:
    found = [name for bit, name in enumerate(VEHICLE_CLASSES) if permissions >> bit & 1]
    return found[0] if len(found) == 1 else "every class"
