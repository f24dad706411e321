"""The program that times sumo-rl. It runs in a Python that has sumo-rl and libsumo.

The program imports nothing of this package. Arguments: network, route file, number of decisions
before the timing, number of decisions per turn. For each line of standard input, the program runs a
turn and prints its processor time in s.
"""

from __future__ import annotations

import os
import sys
import time
from typing import Any


def main() -> None:
    """Serve turns until standard input ends."""
    os.environ["LIBSUMO_AS_TRACI"] = "1"
    import sumo

    os.environ.setdefault("SUMO_HOME", sumo.SUMO_HOME)
    import pettingzoo.utils as utils

    if not hasattr(utils, "agent_selector"):  # the name before PettingZoo 1.25, which sumo_rl needs
        utils.agent_selector = utils.AgentSelector
    import sumo_rl

    net_file, route_file, before, turn = sys.argv[1], sys.argv[2], *map(int, sys.argv[3:5])
    environment = sumo_rl.SumoEnvironment(
        net_file=net_file,
        route_file=route_file,
        begin_time=int(float(sys.argv[5])),
        num_seconds=10**6,
        delta_time=5,
        min_green=5,
        max_green=10**6,
        yellow_time=2,
        sumo_warnings=False,
        add_system_info=False,
        add_per_agent_info=False,
    )
    environment.reset()
    _step(environment, before)
    print("ready", flush=True)
    for _ in sys.stdin:
        began_s = time.process_time()
        _step(environment, turn)
        print(time.process_time() - began_s, flush=True)


def _step(environment: Any, count: int) -> None:
    for _ in range(count):
        signals = environment.traffic_signals
        environment.step({name: _max_pressure(environment.sumo, signals[name]) for name in signals})


def _max_pressure(sumo: Any, signal: Any) -> int:
    """Return the green with the largest pressure: vehicles before minus behind its movements."""
    count = sumo.lane.getLastStepVehicleNumber
    links = sumo.trafficlight.getControlledLinks(signal.id)
    best, best_score = signal.green_phase, None
    for k in range(signal.num_green_phases):
        green = (signal.green_phase + k) % signal.num_green_phases
        state = signal.green_phases[green].state
        moves = {of[0][:2] for at, of in enumerate(links) if of and state[at] in "gG"}
        score = sum(count(before) - count(behind) for before, behind in moves)
        if best_score is None or score > best_score:
            best, best_score = green, score
    return int(best)


if __name__ == "__main__":
    main()
