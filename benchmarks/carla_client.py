"""One of CARLA's clients ticks a world, reads all vehicles, and waits for the frames of sensors.

    python carla_client.py PORT TICKS SENSORS OUTPUT

The program needs CARLA's client and nothing of cavmarl. TICKS is the number of measured ticks; 50
ticks before them are not measured. SENSORS and OUTPUT are JSON files. SENSORS has a list of
blueprints with attributes, which are mounted on the first agent. OUTPUT has the wall time of the
measured ticks in s, the largest number of vehicles, and for each sensor the delays of its frames in
ms. A delay is the time from the call of `tick` to the arrival of the frame of this tick. Frames
that come out of order are left out.
"""

from __future__ import annotations

import json
import sys
import time
from contextlib import suppress
from pathlib import Path
from queue import Empty, Queue
from typing import Any

STEP_S = 0.05
TIMEOUT_S = 20.0
_WARM_UP = 50


class Listener:
    """A sensor and the arrival of its frames."""

    def __init__(self, sensor: Any) -> None:
        self.sensor = sensor
        self.arrivals: Queue[tuple[int, float]] = Queue()
        self.delays_ms: list[float] = []
        sensor.listen(lambda data: self.arrivals.put((data.frame, time.perf_counter())))

    def take(self, frame: int, start_s: float) -> None:
        """Wait for the next frame; store its delay if it is the frame of this tick."""
        with suppress(Empty):
            seen, arrived_s = self.arrivals.get(timeout=TIMEOUT_S)
            if seen == frame:
                self.delays_ms.append(1000.0 * (arrived_s - start_s))

    def result(self) -> dict[str, Any]:
        return {
            "name": self.sensor.type_id.removeprefix("sensor."),
            "delays_ms": self.delays_ms,
        }


def mount(carla: Any, world: Any, vehicle: Any, wanted: list[dict[str, Any]]) -> list[Listener]:
    library = world.get_blueprint_library()
    place = carla.Transform(carla.Location(x=0.5, z=2.4))
    found = []
    for one in wanted:
        blueprint = library.find(one["blueprint"])
        for name, value in one.get("attributes", {}).items():
            blueprint.set_attribute(name, str(value))
        found.append(Listener(world.spawn_actor(blueprint, place, attach_to=vehicle)))
    return found


def main() -> None:
    import carla  # type: ignore[import-not-found, unused-ignore]

    port, ticks, sensors, output = sys.argv[1:]
    client = carla.Client("127.0.0.1", int(port))
    client.set_timeout(TIMEOUT_S)
    world = client.get_world()
    settings = world.get_settings()
    settings.synchronous_mode, settings.fixed_delta_seconds = True, STEP_S
    world.apply_settings(settings)
    world.tick()
    agent = next(
        one
        for one in world.get_actors().filter("vehicle.*")
        if one.attributes["role_name"] == "car_0"
    )
    listeners = mount(carla, world, agent, json.loads(Path(sensors).read_text(encoding="utf-8")))
    for _ in range(_WARM_UP):
        frame = world.tick()
        for listener in listeners:
            listener.take(frame, time.perf_counter())
    for listener in listeners:
        listener.delays_ms.clear()
    most = 0
    begin_s = time.perf_counter()
    for _ in range(int(ticks)):
        start_s = time.perf_counter()
        frame = world.tick()
        for listener in listeners:
            listener.take(frame, start_s)
        places = [one.get_transform() for one in world.get_actors().filter("vehicle.*")]
        most = max(most, len(places))
    wall_s = time.perf_counter() - begin_s
    found = {
        "wall_s": wall_s,
        "vehicles": most,
        "sensors": [listener.result() for listener in listeners],
    }
    for listener in listeners:
        listener.sensor.stop()
        listener.sensor.destroy()
    Path(output).write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main()
