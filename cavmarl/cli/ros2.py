"""`cavmarl ros2`: publishes a world over ROS 2, and drives its vehicles by ROS messages."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rich.console import Console
from rich.table import Table

from cavmarl.cli.lead import SecretFile, address_of, read_secret, run_episode
from cavmarl.cli.output import (
    OUTPUT,
    WORLD,
    JsonPath,
    OptionalEnvironment,
    about,
    flag,
    grid,
    with_world,
    write_json,
)
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ConfigError, require_all

if TYPE_CHECKING:
    from cavmarl.cosim.ros2.ros_bridge import RosOptions


# The options of the command.
Join = Annotated[
    str | None,
    about("Attach to a world of `cavmarl lead` at this socket or port.", metavar="ADDRESS"),
]
Vehicle = Annotated[
    list[str] | None,
    about("Agent to publish and drive; repeat it for more [default: car_0].", metavar="NAME"),
]
Domain = Annotated[int, about("ROS_DOMAIN_ID.", metavar="N")]
ProfileName = Annotated[
    Literal["plain", "autoware"],
    about("Topic names: `/car_0/…` (plain), or Autoware's names (for one vehicle only)."),
]
Distro = Annotated[
    Literal["humble", "jazzy", "kilted"], about("ROS 2 distribution of the message types.")
]
Waits = Annotated[
    Literal["stamp", "newest"],
    about(
        "Each step waits for a command with the time stamp of the step (stamp), or takes the "
        "newest command without waiting (newest)."
    ),
]
Deadline = Annotated[
    float, about("Maximum seconds of real time that a step waits for a command.", metavar="S")
]
Lag = Annotated[int, about("Maximum age of a command in steps.", metavar="N")]
Ready = Annotated[
    float, about("Maximum seconds that the first step waits for a publisher.", metavar="S")
]
Truth = Annotated[bool, flag("Publish the true states of the driven and of all other vehicles.")]
Names = Annotated[
    Path | None,
    about("File with the names of topics and frames of each sensor.", metavar="FILE", exists=True),
]
Bag = Annotated[
    Path | None,
    about(
        "Write all messages to a rosbag2 bag in a new folder.",
        "--record-rosbag2",
        metavar="FOLDER",
        panel=OUTPUT,
    ),
]
Rig = Annotated[
    str | None,
    about(
        "Sensors: `reference`, `camera`, a name in configs/rigs, or a file [default: the "
        "environment's, or reference].",
        metavar="RIG",
        panel=WORLD,
    ),
]
Steps = Annotated[int | None, about("Maximum number of steps [default: one episode].", metavar="N")]
Pace = Annotated[
    float | None,
    about("Simulated seconds per second of real time [default: as fast as possible].", metavar="X"),
]


@with_world()
def ros2(
    world: WorldSpec,
    env: OptionalEnvironment = "",
    join: Join = None,
    vehicle: Vehicle = None,
    domain: Domain = 0,
    profile: ProfileName = "plain",
    distro: Distro = "jazzy",
    wait: Waits = "stamp",
    deadline_s: Deadline = 1.0,
    lag_steps: Lag = 0,
    ready_s: Ready = 30.0,
    truth: Truth = False,
    names: Names = None,
    bag: Bag = None,
    rig: Rig = None,
    steps: Steps = None,
    pace: Pace = None,
    secret_file: SecretFile = None,
    json_path: JsonPath = None,
) -> None:
    """Publish a world over ROS 2 and drive its vehicles by ROS messages, without ROS installed.

    The bridge follows the clock of the world. It starts the world ENV, or joins a running one.
    """
    require_all(dict.fromkeys(("msgpack", "cyclonedds", "rosbags"), "ros2"))
    from cavmarl.cosim.ros2 import ros_bridge
    from cavmarl.cosim.ros2.ros_topics import read_names

    if bool(env) == (join is not None):
        raise ConfigError("name either an environment to start, or a running world with --join")
    chosen = tuple(vehicle or ["car_0"])
    options = ros_bridge.RosOptions(
        profile=profile,
        distro=distro,
        domain=domain,
        wait=wait,
        deadline_s=deadline_s,
        lag_steps=lag_steps,
        ready_s=ready_s,
        truth=truth,
        names=read_names(names),
        bag=bag,
    )
    if join is not None:
        _refuse_world_options(world, rig, pace)
        secret = read_secret(secret_file)
        found = ros_bridge.join(address_of(join), chosen, options, secret=secret, steps=steps)
    else:
        found = _start(_with_rig(world, rig), chosen, options, steps, pace)
    Console().print(_table(found))
    write_json(json_path, found)


def _refuse_world_options(world: WorldSpec, rig: str | None, pace: float | None) -> None:
    given = {
        "--agents": world.agents,
        "--background": world.background,
        "--set": world.overrides,
        "--seed": world.seed,
        "--rig": rig,
        "--pace": pace,
    }
    wrong = [name for name, value in given.items() if value]
    if wrong:
        raise ConfigError(
            f"{wrong[0]}: with --join, the world already runs; give this option to `cavmarl lead`"
        )


def _with_rig(world: WorldSpec, rig: str | None) -> WorldSpec:
    """Return the world with a rig, and with steps of 0.05 s unless its overrides set another."""
    from cavmarl.config.registry import load_config
    from cavmarl.cosim.stack.stack import RIGS

    if rig is None:
        if load_config(world.env, **world.keywords)[0].rig:
            return world
        rig = "reference"
    given = {"clock.ctrl_dt_s": 0.05, "rig": RIGS.get(rig, rig), **world.overrides}
    return replace(world, overrides=given)


def _start(
    world: WorldSpec,
    vehicles: tuple[str, ...],
    options: RosOptions,
    steps: int | None,
    pace: float | None,
) -> dict[str, Any]:
    """Run an episode of a world and its bridge."""
    from cavmarl.cosim.ros2.bridged_world import BridgedWorld
    from cavmarl.cosim.time_master import RealTime
    from cavmarl.env.parallel import parallel_env

    pacer = None if pace is None else RealTime(pace)
    with closing(parallel_env(world.env, **world.keywords)) as made:
        with BridgedWorld(made, vehicles, options, pacer=pacer) as bridged:
            run = run_episode(bridged.world, world.seed, steps, "end")
        return {**bridged.report, "state_hash": run["state_hash"]}


def _table(found: dict[str, Any]) -> Table:
    rows = [
        (topic, f"{count:,}", f"{count / max(found['time_s'], 1e-9):.1f}")
        for topic, count in sorted(found["sent"].items())
    ]
    counts = "; ".join(
        f"{vehicle}: " + ", ".join(f"{number} {name}" for name, number in each.items() if number)
        for vehicle, each in found["controls"].items()
    )
    title = f"{found['steps']} steps, {found['time_s']:g} s"
    return grid(("topic", "messages", "per second"), rows, title, f"commands of {counts}")
