"""Repairs a network without its source, by writing it again with netconvert."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from cavmarl.core.atomic_file import draft_folder
from cavmarl.core.errors import MapError
from cavmarl.maps.defects import Defect, cut_off_edges, find_defects, strips_of
from cavmarl.maps.net_document import NetDocument
from cavmarl.maps.netconvert_process import run_netconvert
from cavmarl.maps.provenance import head_of, read_provenance
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network

_TIMEOUT_S = 600.0


def mend(source: Path, target: Path, before: Sequence[Defect]) -> tuple[list[str], list[Defect]]:
    """Write a network again, without unconnected parts and with new right of way and signals.

    Opposite edges on the same strip are drawn side by side, as the reader places them.

    Args:
        source: a SUMO network.
        target: file of the repaired network.
        before: defects of the source.

    Return the changes, and the defects of the repaired network.

    Raises MapError: netconvert fails, or the target is the source.
    """
    if target.exists() and target.samefile(source):
        raise MapError(f"{target}: the target is the source: give another target")
    network = read_network(source)
    cut = [network.edge_ids[edge] for edge in cut_off_edges(network)]
    arguments = ["--sumo-net-file", str(source)]
    if cut:
        arguments += ["--remove-edges.explicit", ",".join(cut)]
    with draft_folder(target.parent) as folder:
        draft = folder / "mended.net.xml"
        run_netconvert([*arguments, "-o", str(draft)], source, _TIMEOUT_S)
        facts = read_provenance(source) | {"mended": f"{len(cut)} edges removed"}
        document = NetDocument(draft)
        _move_apart(document, read_network(draft))
        draft.write_bytes(document.content(head_of(facts)))
        after = find_defects(read_network(draft), draft)
        os.replace(draft, target)
    done = [f"edge {name}: removed, because it is not connected to the rest" for name in cut]
    left = {(defect.kind, defect.name) for defect in after}
    done += [
        f"{defect.kind} {defect.name}: repaired"
        for defect in before
        if (defect.kind, defect.name) not in left and defect.kind != "unreachable part"
    ]
    return done, after


def _move_apart(document: NetDocument, network: RoadNetwork) -> None:
    """Draw edges that share a strip, and the paths at their ends, where the reader placed them."""
    moved = {
        lane
        for strip in strips_of(network, document)
        for lane in (*strip.one.lanes, *strip.other.lanes)
    }
    lanes, links = network.lanes, network.links
    ends = links[lanes["link"]][["from_lane", "to_lane"]].tolist()
    rows = {
        network.lane_ids[row]: row
        for row in range(len(lanes))
        if row in moved or (lanes["internal"][row] and not moved.isdisjoint(ends[row]))
    }
    for lane in document.lanes:
        if lane.id in rows:
            size = lane.points.shape[1]
            places = network.lane_polyline(rows[lane.id])[:, :size].tolist()
            lane.element.set("shape", " ".join(",".join(f"{x:.3f}" for x in p) for p in places))
            lane.element.set("customShape", "1")
