"""Construction of the parts of a tick: traffic, shards, components and the departure queue."""

from __future__ import annotations

from cavmarl.config.env import EnvConfig
from cavmarl.core.memory import Zeros
from cavmarl.driving.vehicles import blank_vehicle
from cavmarl.engine.component import Component, ComponentContext
from cavmarl.engine.external_component import ExternalComponent
from cavmarl.engine.lane_component import LaneComponent
from cavmarl.engine.limit_component import LimitComponent
from cavmarl.engine.override_component import OverrideComponent
from cavmarl.engine.rig_component import RigComponent
from cavmarl.engine.scenario_cues import Cues
from cavmarl.engine.shared_outputs import SharedOutputs
from cavmarl.engine.signal_component import SignalComponent
from cavmarl.engine.tick import Tick
from cavmarl.engine.v2x_component import V2xComponent
from cavmarl.handoff.shard_setup import divide
from cavmarl.roads.network import RoadNetwork
from cavmarl.sensors.mounted.frames import Frames
from cavmarl.sensors.registry import frame_layout, frames_in
from cavmarl.traffic.demand import DemandFile
from cavmarl.traffic.departure_queue import make_departure_queue
from cavmarl.traffic.native import NativeTraffic
from cavmarl.traffic.scenarios.library import plan_scene
from cavmarl.traffic.scenarios.logged_traffic import logged_commands
from cavmarl.traffic.sumo.sumo_demand import SumoDemand
from cavmarl.zones.partition.zone_layouts import cut_map
from cavmarl.zones.partition.zone_partition import ZonePartition


def make_tick(
    config: EnvConfig,
    network: RoadNetwork,
    partition: ZonePartition,
    demand: DemandFile | SumoDemand | None,  # vehicles in addition to the generator's
    shared: SharedOutputs,  # signals and outputs of all zones
    frames: Frames,  # samples of the mounted sensors
    zeros: Zeros,  # allocates large arrays
    # traffic of another simulation with the same environment and number of worlds; None: made here
    traffic: NativeTraffic | None,
    late_ticks: int = 0,  # see `divide`
) -> Tick:
    """Make the shards of W worlds and the tick that runs their phases."""
    num_worlds = shared.outputs.present.shape[0]
    blank = blank_vehicle()
    if traffic is None:
        traffic = NativeTraffic(
            network=network,
            traffic=config.traffic,
            population=config.population,
            blank=blank,
            dt=config.clock.sim_dt_s,
            horizon_s=config.horizon_s,
            file=None if isinstance(demand, SumoDemand) else demand,
            num_worlds=num_worlds,
            zeros=zeros,
            scene=plan_scene(config.scenario, network, config.population.agents),
            sumo=demand if isinstance(demand, SumoDemand) else None,
            lane_changes=config.map.changed_lanes > 0,
        )
    shards, division = divide(
        config, network, partition, traffic, shared.outputs, num_worlds, zeros, late_ticks
    )
    attached = attach(
        ComponentContext(
            config=config,
            network=network,
            num_worlds=num_worlds,
            shards=shards,
            division=division,
            travel=shards[0].travel,
            outputs=shared.outputs,
            zeros=zeros,
            frames=frames,
            lane_plans=traffic.lane_plans,
            changed_at=traffic.changed_at,
            num_persons=traffic.num_persons,
            replayed=None
            if traffic.num_replayed == 0 or traffic.scene is None
            else logged_commands(traffic.scene.log, traffic.type_rows, config.clock.ctrl_dt_s),
        )
    )
    departures = make_departure_queue(num_worlds, traffic.capacity, network.arrays, blank.dtype)
    return Tick(shards, division, traffic, shared, departures, attached)


def attach(host: ComponentContext) -> tuple[Component, ...]:
    """Make the components that the environment configures, in the order in which they act."""
    parts: list[Component] = []
    messages = V2xComponent(host) if host.config.v2x.enabled else None
    lanes = LaneComponent(host) if host.config.may_change_lanes else None
    if lanes is not None:
        parts.append(lanes)
    if host.config.scenario.name:
        parts.append(Cues(host.travel.scripts.cues, host.shards, host.division))
    if host.config.population.external or host.replayed is not None or host.num_persons:
        parts.append(ExternalComponent(host))
    if host.config.signals.overrides:
        parts.append(OverrideComponent(host))
    if host.config.signals.are_controlled:
        parts.append(SignalComponent(host, messages))
    if host.config.limits.are_controlled and lanes is not None:
        parts.append(LimitComponent(host, lanes))
    if host.config.rig:
        parts.append(RigComponent(host))
    if messages is not None:
        parts.append(messages)
    return tuple(parts)


def make_frames(config: EnvConfig, num_worlds: int, zeros: Zeros) -> Frames:
    """Allocate arrays for the samples of all agents' rigs."""
    layout = frame_layout(config, num_worlds)
    return frames_in({name: zeros(shape, dtype=kind) for name, (kind, shape) in layout.items()})


def cut_zones(config: EnvConfig, network: RoadNetwork) -> ZonePartition:
    settings = config.zones
    return cut_map(
        network,
        settings.layout,
        settings.count,
        avoid_junctions=settings.avoid_junctions,
        weight=settings.weight,
    )
