"""Snapshots for followers: their vehicles in the world, and new samples of the sensors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavmarl.cosim.actors.client_actors import ActorOrder, ClientActor
from cavmarl.cosim.followers.follower_messages import (
    ActorView,
    ArrayView,
    FollowerSnapshot,
    SensorView,
    VehicleView,
    Welcome,
)
from cavmarl.cosim.stack.signal_reading import SPAT
from cavmarl.env.external_agents import external_id
from cavmarl.env.parallel import CavEnv
from cavmarl.env.vector import CavVectorEnv
from cavmarl.parallel.worlds.step_arrays import Driven
from cavmarl.roads.network import VEHICLE_CLASSES, RoadNetwork
from cavmarl.roads.shown_signals import signal_codes
from cavmarl.sensors.mounted.frames import SensorFrames

# Columns of the array `truth`, as in `engine.world_frame.SEEN`; one row for each vehicle.
TRUTH = (
    "id", "agent", "vclass", "x", "y", "z", "heading", "pitch", "speed", "accel", "steering",
    "length", "width", "height",
)  # fmt: skip


def welcome_to(env: CavEnv | CavVectorEnv, vehicles: Sequence[str], tick: int) -> Welcome:
    """Return the world's clock and the sensors of its vehicles.

    `vehicles`: assigned to the follower. `tick`: the master's tick.
    """
    action, clock = env.config.action, env.config.clock
    return Welcome(
        environment=f"{env.config.name}-v{env.config.version}",
        map_hash=env.network.source_hash,
        vehicles=list(vehicles),
        tick=tick,
        dt_s=clock.sim_dt_s,
        ticks_per_step=clock.ticks_per_step,
        control_latency_ticks=clock.control_latency_ticks,
        action=action.kind,
        acceleration_mps2=action.acceleration_mps2,
        steering_rad=action.steering_rad,
        sensors=[
            SensorView(name, list(sensor.units), asdict(sensor))
            for name, sensor in env.config.rig.items()
        ],
    )


class SeenActor(NamedTuple):
    """An actor, for a snapshot."""

    name: str
    view: ActorView
    frames: Mapping[str, SensorFrames]  # new samples of its sensors


def see_actors(
    env: CavEnv, actors: Iterable[ClientActor], rows: Mapping[int, np.void]
) -> list[SeenActor]:
    """Return actors as they are in the world, or as they will enter.

    `rows`: VEHICLE of the actors in the world, by slot.
    """
    seen = []
    for actor in actors:
        row, rig = rows.get(actor.slot), actor.order.rig
        agent = external_id(actor.slot) if rig and actor.slot >= 0 else ""
        if row is None:
            seen.append(SeenActor(actor.name, _coming(actor.order, agent), {}))
            continue
        view = ActorView(
            vehicle_id=int(row["id"]),
            agent=agent,
            x=float(row["x"]),
            y=float(row["y"]),
            z=float(row["z"]),
            heading=float(row["heading"]),
            pitch=float(row["pitch"]),
            speed=float(row["speed"]),
            hit_id=int(row["hit"]),
        )
        frames = env.frames(agent) if agent else {}
        carried = _new_samples({name: frames[name] for name in rig})
        seen.append(SeenActor(actor.name, view, carried))
    return seen


def _coming(order: ActorOrder, agent: str) -> ActorView:
    """Return the view of an actor that enters with the next step."""
    z = 0.0 if order.z is None else order.z
    return ActorView(-1, agent, order.x, order.y, z, order.heading, 0.0, order.speed, -1)


class SnapshotTime(NamedTuple):
    """The time of a snapshot."""

    frame: int  # consecutive number
    episode: int  # increases with each reset
    tick: int  # tick of the world, since its reset
    is_over: bool  # whether the episode has ended


def take_snapshot(
    env: CavEnv | CavVectorEnv,
    agents: Sequence[int],
    moment: SnapshotTime,
    world: int = 0,
    truth: bool = False,
    actors: Sequence[SeenActor] = (),
) -> tuple[FollowerSnapshot, list[NDArray[Any]]]:
    """Return the snapshot for a follower, and its arrays.

    `env`: the world or worlds. `agents`: indices of the follower's agents. `moment`: time of the
    snapshot. `truth`: whether it contains all vehicles of the world. `actors`: the follower's
    actors.
    """
    worlds = env.worlds.arrays
    due = [k for k in agents if worlds.mask[world, k] and not moment.is_over]
    vehicles: dict[str, VehicleView] = {}
    views: list[ArrayView] = []
    arrays: list[NDArray[Any]] = []
    time_s = moment.tick * env.config.clock.sim_dt_s
    if truth:
        rows = env.world_frames([world])[0].vehicles
        true = np.stack([rows[name].astype(np.float64) for name in TRUTH], axis=-1)[np.newaxis]
        views.append(_array("", "truth", true, np.array([time_s]), np.zeros(1, np.bool_)))
        arrays.append(true)
    if due:
        by_agent = {vehicle.agent: vehicle for vehicle in env.worlds.driven(world, due)}
        for k in due:
            name = env.possible_agents[k]
            vehicles[name] = _view(env.network, by_agent[k])
            for sensor, seen in _due(env, world, k, time_s).items():
                data = np.ascontiguousarray(seen.data)
                views.append(_array(name, sensor, data, seen.stamp_s, seen.lost))
                arrays.append(data)
            messages = by_agent[k].heard
            if messages is not None:
                data = np.array(messages, dtype=np.int32).reshape(1, -1, 3)
                views.append(_array(name, SPAT, data, np.array([time_s]), np.zeros(1, np.bool_)))
                arrays.append(data)
    for actor in actors:
        for sensor, seen in actor.frames.items():
            data = np.ascontiguousarray(seen.data)
            views.append(_array(actor.name, sensor, data, seen.stamp_s, seen.lost))
            arrays.append(data)
    if due or (actors and not moment.is_over):
        shown = _signals(env, world)
        views.append(_array("", "signals", shown, np.array([time_s]), np.zeros(1, np.bool_)))
        arrays.append(shown)
    return FollowerSnapshot(
        moment.frame,
        moment.episode,
        moment.tick,
        time_s,
        moment.is_over,
        vehicles,
        views,
        {actor.name: actor.view for actor in actors},
    ), arrays


def _due(
    env: CavEnv | CavVectorEnv, world: int, agent: int, time_s: float
) -> dict[str, SensorFrames]:
    """Return an agent's sensor samples of the last step; without a rig, its observation."""
    arrays = env.worlds.arrays
    if not arrays.frames:
        seen = arrays.observations[world, agent : agent + 1]
        now, lost = np.array([time_s]), np.zeros(1, dtype=np.bool_)
        return {"observation": SensorFrames(seen, now, lost, np.ones((), dtype=np.int64))}
    return _new_samples({name: each.of(world, agent) for name, each in arrays.frames.items()})


def _new_samples(frames: Mapping[str, SensorFrames]) -> dict[str, SensorFrames]:
    """Return the samples of the last step, of the sensors of one vehicle."""
    found = {}
    for name, (data, stamp_s, lost, fresh) in frames.items():
        if fresh:
            found[name] = SensorFrames(data[-fresh:], stamp_s[-fresh:], lost[-fresh:], fresh)
    return found


def _array(
    vehicle: str,
    name: str,
    data: NDArray[Any],
    stamp_s: NDArray[np.float64],
    lost: NDArray[np.bool_],
) -> ArrayView:
    shape = list(data.shape)
    return ArrayView(vehicle, name, data.dtype.str, shape, stamp_s.tolist(), lost.tolist())


def _signals(env: CavEnv | CavVectorEnv, world: int) -> NDArray[np.uint8]:
    """Return (1, num_links) the SIGNAL_* code that each link's signal shows."""
    return signal_codes(env.network, env.worlds.signal_phases(world))[np.newaxis]


def _view(network: RoadNetwork, vehicle: Driven) -> VehicleView:
    lane = int(network.edges["first_lane"][vehicle.goal_edge])
    end = network.lane_polyline(lane)[-1]
    last_point = network.lanes["first_point"][lane] + network.lanes["num_points"][lane] - 1
    return VehicleView(
        vehicle_id=vehicle.vehicle_id,
        vclass=VEHICLE_CLASSES[vehicle.vclass],
        length_m=vehicle.length_m,
        width_m=vehicle.width_m,
        wheelbase_m=vehicle.wheelbase_m,
        goal_edge=network.edge_ids[vehicle.goal_edge],
        goal_m=[float(end[0]), float(end[1])],
        goal_heading_rad=float(network.points["heading"][last_point]),
    )
