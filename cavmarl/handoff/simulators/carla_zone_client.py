"""The program of a process that runs a zone with CARLA's official client.

This file runs as a script, possibly with another Python, and imports nothing of this package:
CARLA's client supports only some versions of Python, and it can abort its process. Requests come as
lines of JSON on standard input; each line is answered with one line.

CARLA's frame is left-handed: y and yaw have the opposite sign.
"""

from __future__ import annotations

import base64
import importlib
import json
import math
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

SPAWN_HEIGHT_M = 0.3  # height above the ground, so that the wheels do not touch the ground
LARGE_M = 7.0  # longer vehicles are buses or trucks
WHEELBASE_SHARE = 0.6  # wheelbase / length of CARLA's vehicles
MOST_SLIP = 0.6  # largest sine of the slip angle
PLACED_TICKS = 2  # ticks for which a vehicle is placed, before it drives by its own physics
FIRST_FRAMES = 20  # number of first frames of a new sensor that may be missing
FIRST_FRAME_S = 0.2  # time to wait for each of these frames
PREDECESSOR_S = 3.0  # longest wait for the end of the synchronous mode of another client
SEEN_LANES = 0.5  # minimum share of the sent places that must be on a road of CARLA's map
STATES = {"r": "Red", "y": "Yellow", "u": "Yellow", "g": "Green", "G": "Green", "s": "Red"}

Row = Sequence[float]


class CarState(NamedTuple):
    """The state of a vehicle in cavmarl's frame: m, rad, m/s."""

    x: float
    y: float
    z: float
    heading: float
    speed: float

    @classmethod
    def of(cls, row: Row) -> CarState:
        return cls(*row[1:6])

    def after(self, dt: float) -> CarState:
        """Return the state after driving straight on for `dt` s."""
        step_m = self.speed * dt
        x, y = self.x + step_m * math.cos(self.heading), self.y + step_m * math.sin(self.heading)
        return self._replace(x=x, y=y)


class Car:
    """An actor of CARLA that represents a vehicle."""

    def __init__(self, actor: Any, pose: CarState) -> None:
        self.actor = actor
        self.pose = pose  # where the actor was placed last
        self.length_m = 2.0 * actor.bounding_box.extent.x
        self.is_owned = False
        self.is_seen = False  # whether a snapshot has had the actor; before, it reads as (0, 0, 0)
        self.left = PLACED_TICKS  # remaining ticks in which the actor is placed
        self.sensors: dict[str, MountedActor] = {}  # name → sensor, if the vehicle is an agent's

    def unmount(self) -> None:
        """Remove the sensors."""
        for sensor in self.sensors.values():
            sensor.close()
        self.sensors.clear()


class MountedActor:
    """A sensor on a vehicle, and the data of its newest frame."""

    def __init__(self, actor: Any) -> None:
        self._actor = actor
        self._come = threading.Condition()
        self._newest: tuple[int, bytes] = (-1, b"")  # number of the frame, its data
        self._asked = 0
        actor.listen(self._take)

    def _take(self, taken: Any) -> None:
        with self._come:
            self._newest = taken.frame, bytes(taken.raw_data)
            self._come.notify()

    def data(self, frame: int, timeout_s: float) -> bytes | None:
        """Wait for the data of a frame. Return None if the new sensor has sent no frame yet."""
        self._asked += 1
        with self._come:
            is_new = self._newest[0] < 0 and self._asked <= FIRST_FRAMES
            if not self._come.wait_for(
                lambda: self._newest[0] >= frame, FIRST_FRAME_S if is_new else timeout_s
            ):
                if is_new and self._newest[0] < 0:
                    return None
                raise ValueError(
                    f"a sensor of CARLA has not sent frame {frame} within {timeout_s:g} s; its "
                    f"newest frame is {self._newest[0]}"
                )
            return self._newest[1]

    def close(self) -> None:
        self._actor.stop()
        self._actor.destroy()


class Zone:
    """The vehicles of a zone in CARLA's world.

    Args:
        start: host, port, timeout in s, length of a tick in s, places on lanes, and sensors that
            are mounted on agents' vehicles.
    """

    def __init__(self, start: dict[str, Any]) -> None:
        self._carla: Any = importlib.import_module("carla")
        self._client = self._carla.Client(start["host"], start["port"])
        self._client.set_timeout(start["timeout_s"])
        self._dt, self._timeout_s = start["dt"], start["timeout_s"]
        self._world = self._client.get_world()
        self._map = self._world.get_map()
        self._check_map(start["places"])
        self._await_predecessor()
        self._before = self._world.get_settings()
        settings = self._world.get_settings()
        settings.synchronous_mode, settings.fixed_delta_seconds = True, self._dt
        self._world.apply_settings(settings)
        self._cars: dict[int, Car] = {}
        self._mounts: dict[str, dict[str, Any]] = start["mounts"]
        self._frame = 0  # number of the last tick
        lights = {
            light.get_opendrive_id(): light
            for light in self._world.get_actors().filter("traffic.traffic_light")
        }
        id_of = _signal_ids(self._map.to_opendrive())
        self._lights = {name: lights[one] for name, one in id_of.items() if one in lights}
        self._shown: dict[str, str] = {}
        self._world.freeze_all_traffic_lights(True)  # stop the signals' own programs
        library = self._world.get_blueprint_library().filter("vehicle.*")
        self._blueprints = sorted(library, key=lambda one: str(one.id))

    def _await_predecessor(self) -> None:
        """Wait while another client drives the server: the client of a process that has died.

        That client removes its actors, and then ends the synchronous mode.
        """
        until_s = time.monotonic() + PREDECESSOR_S
        while self._world.get_settings().synchronous_mode and time.monotonic() < until_s:
            time.sleep(0.05)

    def _check_map(self, places: Sequence[Sequence[float]]) -> None:
        on_road = sum(
            self._map.get_waypoint(self._carla.Location(x, -y, z), project_to_road=False)
            is not None
            for x, y, z in places
        )
        if on_road < SEEN_LANES * len(places):
            raise ValueError(
                f"its map {self._map.name} is wrong: {len(places) - on_road} of "
                f"{len(places)} places on lanes are off its roads; load the map of this world "
                "(cavmarl map export NAME --carla --opendrive FILE)"
            )

    def prepare(self, rows: Sequence[Row]) -> dict[int, str]:
        refused = {}
        for row in rows:
            vehicle = int(row[0])
            reason = "" if vehicle in self._cars else self._place(vehicle, row)
            if reason:
                refused[vehicle] = reason
        return refused

    def spawn(self, rows: Sequence[Row]) -> None:
        for row in rows:
            vehicle = int(row[0])
            if vehicle not in self._cars and (reason := self._place(vehicle, row)):
                raise ValueError(f"CARLA refuses vehicle {vehicle}, which it accepted: {reason}")
            car = self._cars[vehicle]
            car.is_owned, car.left = True, 0 if car.is_seen else PLACED_TICKS
            car.actor.set_simulate_physics(True)
            car.actor.set_target_velocity(self._velocity(CarState.of(row)))
            if row[8] >= 0:
                self._mount(car)

    def _mount(self, car: Car) -> None:
        """Mount all sensors on the vehicle of an agent."""
        library, carla = self._world.get_blueprint_library(), self._carla
        for name, mount in self._mounts.items():
            blueprint = library.find(mount["blueprint"])
            for attribute, value in mount["attributes"].items():
                blueprint.set_attribute(attribute, value)
            place = carla.Location(*mount["place"])
            there = carla.Transform(place, carla.Rotation(*mount["turn"]))
            actor = self._world.spawn_actor(blueprint, there, attach_to=car.actor)
            car.sensors[name] = MountedActor(actor)

    def sense(self, sensor: str, vehicles: Sequence[int]) -> dict[int, str]:
        """Return the last tick's frames of a sensor, by vehicle, in base64; some may be missing."""
        found = {}
        for vehicle in vehicles:
            data = self._cars[vehicle].sensors[sensor].data(self._frame, self._timeout_s)
            if data is not None:
                found[vehicle] = base64.b64encode(data).decode()
        return found

    def _place(self, vehicle: int, row: Row) -> str:
        """Add an actor without physics. Return the reason if CARLA refuses it, else ""."""
        pose = CarState.of(row)
        there = self._transform(pose._replace(z=pose.z + SPAWN_HEIGHT_M))
        try:
            actor = self._world.spawn_actor(self._blueprint(row[6]), there)
        except RuntimeError as error:
            return str(error)
        actor.set_simulate_physics(False)
        self._cars[vehicle] = Car(actor, pose)
        return ""

    def _blueprint(self, length_m: float) -> Any:
        bases = ("bus", "truck") if length_m > LARGE_M else ("car",)
        fitting = [
            one
            for one in self._blueprints
            if one.has_attribute("base_type") and str(one.get_attribute("base_type")) in bases
        ]
        return (fitting or self._blueprints)[0]

    def drop(self, vehicles: Sequence[int]) -> None:
        """Release vehicles. Vehicles that remain visible become ghosts in `show`."""
        for vehicle in vehicles:
            car = self._cars[vehicle]
            car.is_owned = False
            car.unmount()
            car.actor.set_simulate_physics(False)

    def show(self, ghosts: Sequence[Row], signals: dict[str, str]) -> None:
        near = {int(row[0]): row for row in ghosts}
        for vehicle in [one for one, car in self._cars.items() if not car.is_owned]:
            if vehicle not in near:
                self._cars.pop(vehicle).actor.destroy()
        moves = []
        for vehicle, row in near.items():
            if vehicle not in self._cars:
                self._place(vehicle, row)  # a ghost that CARLA refuses is not shown in this tick
                continue
            car = self._cars[vehicle]
            car.pose = CarState.of(row).after(self._dt)  # where the ghost is at the end of the tick
            moves.append(self._move(car))
        if moves:
            self._client.apply_batch_sync(moves, False)
        for name, letter in signals.items():
            light = self._lights.get(name)
            if light is not None and self._shown.get(name) != letter:
                self._shown[name] = letter
                light.set_state(getattr(self._carla.TrafficLightState, STATES.get(letter, "Off")))

    def advance(
        self, wanted: Sequence[Row], aims: Sequence[Sequence[float] | None]
    ) -> list[list[float]]:
        """Run a tick. Return (id, x, y, heading, speed) of the owned vehicles."""
        commands = []
        before = self._world.get_snapshot()
        for row, aim in zip(wanted, aims, strict=True):
            car, pose = self._cars[int(row[0])], CarState.of(row)
            now = self._find(before, int(row[0]))
            if now is not None and car.left == 0:
                commands.append(self._drive(car, now, pose, aim))
            else:
                commands.append(self._move(car, pose))
            car.pose = pose
        self._client.apply_batch_sync(commands, False)
        self._frame = self._world.tick(self._timeout_s)
        after = self._world.get_snapshot()
        found = []
        for row in wanted:
            car, now = self._cars[int(row[0])], self._find(after, int(row[0]))
            pose = now if now is not None and car.is_seen and car.left == 0 else car.pose
            found.append([row[0], pose.x, pose.y, pose.heading, pose.speed])
        for car in self._cars.values():
            if car.is_seen:
                car.left = max(0, car.left - 1)
            car.is_seen |= after.find(car.actor.id) is not None
        return found

    def _find(self, snapshot: Any, vehicle: int) -> CarState | None:
        """Return the state of a vehicle in a snapshot; None if no snapshot has had it yet."""
        car = self._cars[vehicle]
        state = snapshot.find(car.actor.id)
        if state is None and car.is_seen:
            raise ValueError(f"CARLA no longer has the actor of vehicle {vehicle}")
        return None if state is None else self._read(state)

    def _move(self, car: Car, pose: CarState | None = None) -> Any:
        there = self._transform(car.pose if pose is None else pose)
        return self._carla.command.ApplyTransform(car.actor, there)

    def _drive(self, car: Car, now: CarState, wanted: CarState, aim: Sequence[float] | None) -> Any:
        """Return the control by which a vehicle reaches its wanted speed, and steers.

        A vehicle steers to its aim by pure pursuit (Coulter 1992), an agent to the wanted heading.
        """
        accel = (wanted.speed - now.speed) / self._dt
        if aim is None:
            turn = math.remainder(wanted.heading - now.heading, 2.0 * math.pi)
            curvature = turn / (max(now.speed, 0.1) * self._dt)
        else:
            dx, dy = aim[0] - now.x, aim[1] - now.y
            angle = math.atan2(dy, dx) - now.heading
            curvature = 2.0 * math.sin(angle) / max(math.hypot(dx, dy), 1.0)
        slip = 0.5 * WHEELBASE_SHARE * car.length_m * curvature
        slip = min(max(slip, -MOST_SLIP), MOST_SLIP)
        steer = math.atan(2.0 * math.tan(math.asin(slip)))
        control = self._carla.VehicleAckermannControl(
            steer=-steer, speed=max(0.0, now.speed + 0.5 * accel), acceleration=abs(accel)
        )
        return self._carla.command.ApplyVehicleAckermannControl(car.actor, control)

    def _read(self, state: Any) -> CarState:
        there, velocity = state.get_transform(), state.get_velocity()
        heading = -math.radians(there.rotation.yaw)
        speed = velocity.x * math.cos(heading) - velocity.y * math.sin(heading)
        place = there.location
        return CarState(place.x, -place.y, place.z, math.remainder(heading, 2.0 * math.pi), speed)

    def _transform(self, pose: CarState) -> Any:
        yaw = -math.degrees(pose.heading)
        place = self._carla.Location(pose.x, -pose.y, pose.z)
        return self._carla.Transform(place, self._carla.Rotation(yaw=yaw))

    def _velocity(self, pose: CarState) -> Any:
        cos, sin = math.cos(pose.heading), math.sin(pose.heading)
        return self._carla.Vector3D(pose.speed * cos, -pose.speed * sin, 0.0)

    def close(self) -> None:
        """Remove all actors, and restore the settings of CARLA's world."""
        for car in self._cars.values():
            car.unmount()
            car.actor.destroy()
        self._cars.clear()
        self._world.freeze_all_traffic_lights(False)
        self._world.apply_settings(self._before)


def _signal_ids(document: str) -> dict[str, str]:
    """Return the ids of the signals in an OpenDRIVE document, by name."""
    found = {}
    for element in re.findall(r"<signal\s[^>]*>", document):
        values = dict(re.findall(r'(\w+)="([^"]*)"', element))
        found[values.get("name", "")] = values.get("id", "")
    return found


def answer(zone: Zone, kind: str, content: dict[str, Any]) -> Any:
    """Return the result of a request."""
    calls: dict[str, Callable[..., Any]] = {
        "prepare": zone.prepare,
        "spawn": zone.spawn,
        "drop": zone.drop,
        "show": zone.show,
        "advance": zone.advance,
        "sense": zone.sense,
        "close": zone.close,
    }
    return calls[kind](**content)


def main() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # keep the output of CARLA's client apart from the answers
    zone: Zone | None = None
    for line in sys.stdin:
        content = json.loads(line)
        kind = content.pop("do")
        try:
            if zone is None:
                zone, result = Zone(content), None
            else:
                result = answer(zone, kind, content)
            text = json.dumps({"result": result})
        except Exception as error:  # the client raises many kinds of exceptions
            text = json.dumps({"error": f"{type(error).__name__}: {error}"})
        answers.write(text + "\n")
        answers.flush()
    if zone is not None:  # the parent process has ended
        zone.close()


if __name__ == "__main__":
    main()
