"""Runs of controllers of signals on one map and demand, and of SUMO with the map's programs."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import defusedxml.ElementTree

from cavmarl.core.errors import ConfigError
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import load_world
from cavmarl.evaluate.signals.signal_meter import LATE_S, SignalFigures, SignalMeter, is_jammed
from cavmarl.evaluate.traffic.native_side import idle_commands
from cavmarl.evaluate.traffic.sumo_side import SumoJob, start_sumo, sumo_process
from cavmarl.roads.shown_signals import signal_codes
from cavmarl.signals.controllers import SignalController, make_controller
from cavmarl.signals.kernels.green_choices import SINCE

TICK_S = 0.2
OWN_PROGRAM = "map"  # the map's own programs, with their own yellow; no signal is controlled


def run_controller(
    env: str | Path,
    controller: str | SignalController,
    *,
    seconds: int,
    seeds: Sequence[int],
    overrides: Mapping[str, Any] | None = None,
) -> list[SignalFigures]:
    """Run a controller of all signals, in one world for each seed.

    Args:
        env: as in `make_vec`; there are no agents of vehicles.
        controller: one of `SIGNAL_CONTROLLERS`, or a controller of all signals; `map`: the map's
            own programs.
        seconds: simulated time.
        seeds: seeds of the worlds.
        overrides: values of further keys.

    Raises:
        ConfigError: there is no such controller; or see `make_vec`.
    """
    if "horizon_s" in (overrides or {}):
        raise ConfigError("horizon_s: the argument `seconds` sets the simulated time; leave it out")
    keys = {
        "clock.sim_dt_s": TICK_S,
        "clock.ctrl_dt_s": 1.0,
        **(overrides or {}),
        "horizon_s": float(seconds + 1),  # so that no world resets in the last step
    }
    if controller != OWN_PROGRAM:
        keys["signals.agents"] = "all"
        if isinstance(controller, str):
            keys["signals.controller"] = controller
    if keys["clock.ctrl_dt_s"] != 1.0:
        raise ConfigError("clock.ctrl_dt_s: figures are sampled every second; leave the key out")
    world = load_world(env, agents=0, overrides=keys)
    world.tell_tolerated()
    simulation = Simulation(
        world.config, world.network, demand=world.demand, partition=world.partition
    )
    chooser = None
    if world.config.signals.are_controlled:
        chooser = make_controller(controller) if isinstance(controller, str) else controller
    return [_measured(simulation, chooser, seconds, seed) for seed in seeds]


def _measured(
    simulation: Simulation, controller: SignalController | None, seconds: int, seed: int
) -> SignalFigures:
    simulation.seed(seed)
    simulation.reset()
    config, network = simulation.config, simulation.network
    meter = SignalMeter(network, config.clock.sim_dt_s)
    ticks_per_s = config.clock.ticks_per_step
    commands, view = idle_commands(simulation), None
    if controller is not None:
        view = simulation.signal_view()
    switches = arrived_before = 0
    for second in range(1, seconds + 1):
        if view is not None and controller is not None:
            since = view.states[..., SINCE].copy()
            commands = replace(commands, signal_choices=controller.choose(view))
        simulation.step(commands)
        if second == seconds - LATE_S:
            arrived_before = simulation.traffic_stats().arrived
        if view is not None:
            switches += int((view.states[..., SINCE] != since).sum())
        meter.sample(
            simulation.vehicles(),
            second * ticks_per_s,
            simulation.departures.orders["due"][0],
            signal_codes(network, simulation.signal_phases()),
        )
    departures = simulation.departures
    queue = departures.queue[0, : departures.num_queue[0]]
    stats = simulation.traffic_stats()
    return meter.result(
        arrived=stats.arrived,
        trip_s=stats.mean_trip_s,
        delay_s=stats.mean_delay_s,
        waiting_s=(seconds * ticks_per_s - queue["due"]) * config.clock.sim_dt_s,
        switches_per_h=None if view is None else 3600.0 * switches / seconds / len(view.table.ids),
        jams=is_jammed(stats.arrived, stats.arrived - arrived_before, seconds),
    )


def run_sumo(job: SumoJob) -> SignalFigures:
    """Run SUMO with the map's own programs; figures that its trips do not have are None."""
    with sumo_process(job) as process:
        return process.submit(_trips_of_sumo, job).result()


def _trips_of_sumo(job: SumoJob) -> SignalFigures:
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "trips.xml"
        libsumo = start_sumo(
            job,
            Path(name),
            f"--tripinfo-output={path}",
            "--tripinfo-output.write-unfinished",
            "--tripinfo-output.write-undeparted",
            "--device.emissions.probability=1",
        )
        for _ in range(round(job.seconds / job.dt_s)):
            libsumo.simulationStep()
        end_s = libsumo.simulation.getTime()
        libsumo.close()
        trips = [
            trip
            for trip in defusedxml.ElementTree.parse(path).iter("tripinfo")
            if job.is_shared(trip.attrib["id"])
        ]

    def values(name: str, among: Sequence[Any]) -> list[float]:
        return [float(trip.attrib[name]) for trip in among]

    departed = [trip for trip in trips if float(trip.attrib["depart"]) >= 0.0]
    arrived = [trip for trip in departed if float(trip.attrib["arrival"]) >= 0.0]
    co2_mg = math.fsum(
        float(emissions.attrib["CO2_abs"])
        for trip in departed
        for emissions in trip.iter("emissions")
    )
    metres = math.fsum(values("routeLength", departed))
    late = sum(second >= end_s - LATE_S for second in values("arrival", arrived))
    lost_s = math.fsum(values("timeLoss", departed)) + math.fsum(values("departDelay", trips))
    return SignalFigures(
        departed=len(departed),
        never_departed=len(trips) - len(departed),
        arrived=len(arrived),
        delay_s=_mean(values("timeLoss", arrived)),
        delay_of_all_s=lost_s / max(len(trips), 1),
        trip_s=_mean(values("duration", arrived)),
        waiting_s=_mean(values("waitingTime", departed)) or 0.0,
        stops=_mean(values("waitingCount", departed)) or 0.0,
        queue=None,
        most_queued=None,
        co2_g_per_km=co2_mg / metres if metres else None,
        switches_per_h=None,
        longest_red_s=None,
        jams=is_jammed(len(arrived), late, job.seconds),
    )


def _mean(values: Sequence[float]) -> float | None:
    return math.fsum(values) / len(values) if values else None
