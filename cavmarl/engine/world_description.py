"""Description of a world for manifests: its configuration, and hashes of its data."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from typing import Any

from cavmarl.config.env import EnvConfig
from cavmarl.core.compiled import sources_digest
from cavmarl.core.extensions import plugin_hashes
from cavmarl.handoff.simulators.simulator_kinds import describe_simulators
from cavmarl.networks.background_driver import background_drivers
from cavmarl.roads.network import RoadNetwork
from cavmarl.traffic.demand import DemandFile
from cavmarl.traffic.sumo.sumo_demand import SumoDemand
from cavmarl.zones.partition.zone_partition import ZonePartition


def describe_world(
    config: EnvConfig,
    network: RoadNetwork,
    demand: DemandFile | SumoDemand | None,
    partition: ZonePartition,
) -> dict[str, Any]:
    """Return the configuration, and the hashes of the roads, demand, zones and kernels.

    `demand_tolerated` lists what was left out or replaced in the demand, with counts. If trained
    drivers drive background vehicles, `background_drivers` has the SHA-256 of each driver's files,
    by the name of the driver.
    """
    drivers = {one.name: one.content_hash for one in background_drivers(config.traffic)}
    resolved = asdict(config)
    text = json.dumps(resolved, sort_keys=True)
    return {
        "environment": f"{config.name}-v{config.version}",
        "config": resolved,
        "config_sha256": hashlib.sha256(text.encode()).hexdigest(),
        "map": network.name,
        "maps": list(network.map_names),
        "map_source_sha256": network.source_hash,
        "map_content_sha256": network.content_hash,
        "demand_content_sha256": None if demand is None else demand.content_hash,
        "demand_tolerated": [] if demand is None else list(demand.tolerated),
        "sumo": demand.version if isinstance(demand, SumoDemand) else None,
        "kernels": sources_digest(),
        "plugins": plugin_hashes(config.registered, config.plugins),  # SHA-256 by module
        "zones": partition.count,
        "zone_simulators": describe_simulators(config.zones.simulators, partition.count),
        "zones_content_sha256": partition.content_hash,
        "signals": {"observed": config.signals.sensing, "rewarded": "truth"}
        if config.signals.are_controlled
        else "their programs",
        "channel": asdict(config.v2x.channel)
        if config.v2x.enabled
        else "none: there are no messages between vehicles",
        **({"background_drivers": drivers} if drivers else {}),
    }
