"""Setup of a `Simulation` before its first step: SUMO, coordinators, warm kernels."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import ConfigError
from cavmarl.driving.vehicles import blank_vehicle
from cavmarl.engine.external_component import ExternalComponent, ExternalPhases
from cavmarl.engine.outside_traffic import SumoPhases
from cavmarl.engine.rig_component import RigComponent
from cavmarl.engine.simulator_component import SimulatorComponent, SimulatorPhases
from cavmarl.engine.tick import Tick
from cavmarl.handoff.coordinator.coordinator_setup import OpenRun, make_coordinators
from cavmarl.handoff.coordinator.handoff_log import HandoffLog
from cavmarl.handoff.simulators.simulator_kinds import check_servers, hosted_zones
from cavmarl.ownership.messages import Switch
from cavmarl.ownership.transfers import TransferLog
from cavmarl.roads.network import RoadNetwork
from cavmarl.traffic.sumo.sumo_demand import SumoDemand
from cavmarl.traffic.sumo.sumo_traffic import SumoTraffic
from cavmarl.zones.reach import longest_move_m


def add_sumo(tick: Tick, demand: object, network: RoadNetwork) -> None:
    """Attach SUMO to the worlds, if it simulates the demand."""
    if isinstance(demand, SumoDemand):
        travel, zoned = tick.traffic.travel, tick.division.zoned
        plans = tick.traffic.own_plan_steps
        lanes = tick.shards[0].own_lanes
        traffic = SumoTraffic(
            demand,
            network,
            travel,
            plans.stop,
            zoned,
            blank_vehicle(),
            lanes,
            tick.traffic.plans.size if plans else 0,
        )
        tick.outside = SumoPhases(traffic)


def add_external(tick: Tick) -> None:
    """Let the caller pose and drive vehicles, if there is room for such vehicles."""
    for part in tick.attached:
        if isinstance(part, ExternalComponent):
            callers = ExternalPhases(part, tick)
            sumo = tick.outside.sumo
            tick.outside = callers if sumo is None else SumoPhases(sumo, callers)


def add_simulators(
    tick: Tick, config: EnvConfig, network: RoadNetwork
) -> SimulatorComponent | None:
    """Let other simulators run zones, if `zones.simulators` names any."""
    hosted = hosted_zones(config.zones.simulators, tick.division.count)
    if not hosted:
        return None
    check_servers(hosted, tick.division.num_worlds)
    for one in hosted:
        one.check_rig(config.rig)
    part = SimulatorComponent(tick, config, network, hosted)
    for other in tick.attached:
        if isinstance(other, RigComponent) and not config.workers.sensors:
            other.rig.sense = part.sense
    tick.attached, tick.outside = (*tick.attached, part), SimulatorPhases(part)
    return part


def add_coordinators(
    tick: Tick,
    config: EnvConfig,
    network: RoadNetwork,
    runs: Sequence[OpenRun] | None,
    hosted: SimulatorComponent | None = None,
) -> tuple[TransferLog, ...]:
    """Let coordinators decide ownership, if there are several zones, a journal or checks.

    Returns:
        One log of transfers per world; none without coordinators.
    """
    zones = config.zones
    is_plain = not (zones.journal or zones.check_invariants or hosted)
    if tick.division.count == 1 and is_plain:
        return ()
    reach_m = longest_move_m(network, tick.traffic.travel, config.clock.sim_dt_s)
    setup = make_coordinators(zones, tick.division, reach_m, runs=runs, gate=hosted)
    tick.coordination = setup.coordination
    if hosted is not None:
        hosted.coordinators = setup.coordination.coordinators
    return setup.transfers


def call_rare_kernels(tick: Tick) -> None:
    """Call the kernels that a first step may skip, so that all kernels are loaded."""
    departures, division = tick.departures, tick.division
    tick.let_in()
    tick.traffic.accept(departures, tick.worlds, tick.peers.running())
    tick.admit()
    tick.executor.leave(departures)
    tick.executor.retire(departures)
    tick.executor.forget(departures)
    tick.executor.gather(*division.gathering)
    division.rehearse_gathering()
    tick.traffic.settle(departures, tick.worlds)
    division.changes.near(0, check_all=True)
    with suppress(ConfigError):
        division.changes.hand_over(0, Switch(-1, 0, 0, 0, False))
    book = HandoffLog(division, 0)
    book.release(book.hand_over(True, sum(division.counts(0)), ()))
    book.reset(0)
