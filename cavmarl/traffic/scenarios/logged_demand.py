"""The demand of a logged scene: vehicles whose built-in drivers follow the logged routes."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from xml.sax.saxutils import quoteattr

from cavmarl.config.env import EnvConfig
from cavmarl.config.traffic import TrafficConfig
from cavmarl.core.errors import ConfigError
from cavmarl.roads.network import RoadNetwork
from cavmarl.traffic.demand import DemandFile, read_demand
from cavmarl.traffic.scenarios.scene import LoggedTraffic


def check_logged_world(config: EnvConfig) -> None:
    """Raise ConfigError if the configuration has keys that a logged scene excludes."""
    traffic, population = config.traffic, config.population
    for key, value, allowed in (
        ("population.background", population.background, 0),
        ("population.mode", population.mode, "closed"),
        ("population.fleet", population.fleet, ()),
        ("traffic.demand", traffic.demand, ()),
    ):
        if value != allowed:
            raise ConfigError(
                f"{key} = {value!r}: a logged scene has its own vehicles; set it to {allowed!r}, "
                "or leave scenario.name out"
            )


def demand_of_log(
    log: LoggedTraffic, network: RoadNetwork, traffic: TrafficConfig
) -> DemandFile | None:
    """Return the demand of the vehicles that react; None if no vehicle reacts.

    Raises ConfigError: `traffic.model` does not name one car-following model.
    """
    if not log.reacting:
        return None
    models = list(traffic.models)
    if len(models) != 1 or traffic.networks:
        raise ConfigError(
            f"traffic.model = {traffic.model!r}: vehicles of a logged scene follow a route, which "
            "trained drivers do not; name one car-following model, such as IDM"
        )
    with TemporaryDirectory() as folder:
        path = Path(folder) / "logged.rou.xml"
        path.write_text(_routes(log, network, models[0]), encoding="utf-8")
        return read_demand([path], network)


def _routes(traffic: LoggedTraffic, network: RoadNetwork, model: str) -> str:
    """Return the file of the vehicles, in the order of their departures."""
    lines = ["<routes>"]
    for number, one in enumerate(traffic.reacting):
        body, seat = one.seat.body, one.seat
        assert body is not None, "seats of a log have bodies"
        lane = network.lanes[seat.lane]
        edges = " ".join(network.edge_ids[edge] for edge in one.edges)
        front_m = min(seat.s + 0.5 * body.length, float(lane["length_m"]))
        index, position = int(lane["index"]), f"{max(front_m, 0.0):.3f}"
        if lane["internal"]:  # the vehicle is placed at the reset
            index, position = 0, "0"
        limit = float(lane["speed_mps"])
        lines += [
            f'<vType id="t{number}" carFollowModel="{model}" length="{body.length:.3f}" '
            f'width="{body.width:.3f}" height="{body.height:.3f}"/>',
            f'<vehicle id={quoteattr(one.track.name)} type="t{number}" '
            f'depart="{one.depart_s:.3f}" departLane="{index}" departPos="{position}" '
            f'departSpeed="{min(seat.speed_mps, limit):.3f}"><route edges="{edges}"/></vehicle>',
        ]
    return "\n".join([*lines, "</routes>", ""])
