"""Small map files, and networks built from them."""

from __future__ import annotations

from pathlib import Path

from cavmarl.maps.netconvert import build_network
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network

_LANE = '<lane id="{id}" type="driving"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane>'
# A straight road of 200 m with a lane in each direction; `<type/>` is a place for its types.
ROAD = (
    '<road name="" length="200" id="1" junction="-1"><type/><planView>'
    '<geometry s="0" x="0" y="0" hdg="0" length="200"><line/></geometry></planView>'
    f'<lanes><laneSection s="0"><left>{_LANE.format(id=1)}</left>'
    '<center><lane id="0" type="none"/></center>'
    f"<right>{_LANE.format(id=-1)}</right></laneSection></lanes></road>"
)


def road_file(*roads: str) -> str:
    """Return the text of a file with these roads."""
    head = '<header revMajor="1" revMinor="6" name="" north="0" south="0" east="0" west="0"/>'
    return f"<OpenDRIVE>{head}{''.join(roads)}</OpenDRIVE>".replace("<type/>", "")


def built_from(folder: Path, name: str, text: str) -> RoadNetwork:
    """Write a map file, and return the network that is built from it."""
    path = folder / name
    path.write_text(text)
    return read_network(build_network(path, folder / "built.net.xml").path)
