"""Changes an OpenDRIVE export into a file that CARLA and its client programs can read.

CARLA's programs look for traffic lights of one type, with one signal on each approach, and find the
lights of a junction by its controllers. Snapshots have room for short signal ids only; the
signal's name keeps netconvert's id. CARLA 0.9.16 reads the header of OpenDRIVE 1.4.
"""

from __future__ import annotations

from collections.abc import Iterator
from xml.etree.ElementTree import Element

import numpy as np

from cavmarl.maps.projection import unproject
from cavmarl.roads.network import RoadNetwork

LIGHT_TYPE = "1000001"
DEFAULT_ORIGIN = (48.0, 11.0)  # latitude and longitude of (0, 0) on a map without a georeference
MAX_ID_BYTES = 31
_MINOR = "4"
_TRAFFIC_LIGHTS = ("1000001", "1000011")  # with and without a light for pedestrians or turns


def origin_of(network: RoadNetwork) -> tuple[float, float]:
    """Return latitude and longitude in degrees of (0, 0) on a map.

    Raises MissingExtraError: the map has a projection, and pyproj is not installed.
    """
    if network.geo is None:
        return DEFAULT_ORIGIN
    longitude, latitude = unproject(np.zeros((1, 2)), network.geo)[0]
    return float(latitude), float(longitude)


def fit_to_carla(root: Element, origin: tuple[float, float]) -> None:
    """Change a document in place.

    Args:
        root: an export of `opendrive.write_opendrive`.
        origin: latitude and longitude in degrees of (0, 0).
    """
    junctions = {junction.get("id", ""): junction for junction in root.iter("junction")}
    controllers = {
        control.get("signalId", ""): controller.get("id", "")
        for controller in root.iterfind("controller")
        for control in controller
    }
    new_ids: dict[str, str] = {}
    for road in root.iterfind("road"):
        has_cars = any(lane.get("type") == "driving" for lane in road.iter("lane"))
        seen: set[str] = set()
        for signals in road.iterfind("signals"):
            for signal in _traffic_lights(signals):
                signal_id, orientation = signal.get("id", ""), signal.get("orientation", "")
                if orientation in seen or not has_cars:
                    signals.remove(signal)
                    continue
                seen.add(orientation)
                _add_controller(road, orientation, junctions, controllers.get(signal_id, ""))
                _widen(road, signal)
                new_ids[signal_id] = _short_id(signal_id, len(new_ids))
                signal.set("name", signal_id)
                signal.set("id", new_ids[signal_id])
    for controller in root.findall("controller"):
        for control in controller.findall("control"):
            signal_id = control.get("signalId", "")
            if signal_id in new_ids:
                control.set("signalId", new_ids[signal_id])
            else:
                controller.remove(control)
        if len(controller) == 0:
            root.remove(controller)
    _remove_paths_without_cars(root)
    header = root.find("header")
    if header is not None:
        header.set("revMinor", _MINOR)
        for old in header.findall("geoReference"):
            header.remove(old)
        latitude, longitude = origin
        place = Element("geoReference")
        place.text = (
            f"+proj=tmerc +lat_0={latitude:.9f} +lon_0={longitude:.9f} +k=1 +x_0=0 +y_0=0 "
            "+datum=WGS84 +units=m +no_defs"
        )
        header.insert(0, place)


def _remove_paths_without_cars(root: Element) -> None:
    """Remove connections of junctions to lanes of other types, at which CARLA's planners fail."""
    driving = {
        (road.get("id"), lane.get("id"))
        for road in root.iterfind("road")
        for lane in road.iter("lane")
        if lane.get("type") == "driving"
    }
    for junction in root.iterfind("junction"):
        for connection in junction.findall("connection"):
            road = connection.get("connectingRoad")
            for link in connection.findall("laneLink"):
                if (road, link.get("to")) not in driving:
                    connection.remove(link)
            if connection.find("laneLink") is None:
                junction.remove(connection)


def _traffic_lights(signals: Element) -> Iterator[Element]:
    for signal in signals.findall("signal"):
        if signal.get("dynamic") == "yes" and signal.get("type") in _TRAFFIC_LIGHTS:
            yield signal


def _short_id(signal_id: str, number: int) -> str:
    """Return an id that fits into a snapshot; ids of signals at joined junctions are too long."""
    return signal_id if len(signal_id.encode()) <= MAX_ID_BYTES else f"light_{number}"


def _widen(road: Element, signal: Element) -> None:
    """Let a signal apply to all lanes of its direction, which have no other signal."""
    signal.set("type", LIGHT_TYPE)
    signal.set("subtype", "-1")
    side = "right" if signal.get("orientation") == "+" else "left"
    numbers = [int(lane.get("id", "0")) for lane in road.iterfind(f"lanes/laneSection/{side}/lane")]
    for validity in signal.findall("validity"):
        signal.remove(validity)
    if numbers:
        signal.append(Element("validity", fromLane=str(min(numbers)), toLane=str(max(numbers))))


def _add_controller(
    road: Element, orientation: str, junctions: dict[str, Element], controller: str
) -> None:
    """Add the id of a signal's controller to the junction at the end of the signal's road."""
    link = road.find("link/" + ("successor" if orientation == "+" else "predecessor"))
    if link is None or link.get("elementType") != "junction" or not controller:
        return
    junction = junctions[link.get("elementId", "")]
    known = [one.get("id") for one in junction.iterfind("controller")]
    if controller not in known:
        junction.append(Element("controller", id=controller, type="0", sequence=str(len(known))))
