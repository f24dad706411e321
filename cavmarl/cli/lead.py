"""`cavmarl lead`: runs a world as the time master of programs that join over a socket."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from secrets import token_hex
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cavmarl.cli.output import (
    WORLD,
    Backend,
    JsonPath,
    RecordAlso,
    RecordPath,
    Workers,
    Zones,
    about,
    flag,
    grid,
    print_error,
    recorded,
    with_world,
    write_json,
)
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ConfigError, FollowerError
from cavmarl.core.private_files import read_private, write_private

if TYPE_CHECKING:
    from cavmarl.cosim.followers.followed_world import FollowedWorld

DEFAULT_PLACE = "cavmarl.sock"

Place = Annotated[
    str,
    about("Path of a Unix socket, or a port of this machine.", "--at", metavar="ADDRESS"),
]


SecretFile = Annotated[
    Path | None,
    about(
        "File with the secret for a world at a port. `cavmarl lead` creates it if it is missing.",
        metavar="FILE",
    ),
]


def read_secret(path: Path | None, may_make: bool = False) -> str:
    """Return the secret in a file, or an empty text without a file.

    With `may_make`, create a missing file that only this user can read.
    """
    if path is None:
        return ""
    if may_make and not path.exists():
        try:
            write_private(path, token_hex(32) + "\n")
        except OSError as error:
            raise ConfigError(f"--secret-file {path}: cannot be written: {error}") from error
    return read_private("--secret-file", path)


def address_of(text: str) -> str | int:
    """Return a port if `text` is a number, otherwise the path of a Unix socket."""
    return int(text) if text.isdecimal() else text


@with_world()
def lead(
    world: WorldSpec,
    at: Place = DEFAULT_PLACE,
    followers: Annotated[
        int, about("Number of followers that must join before the first step.", metavar="N")
    ] = 1,
    steps: Annotated[
        int | None, about("Maximum number of steps [default: one episode].", metavar="N")
    ] = None,
    timeout_s: Annotated[
        float, about("Seconds that a step waits for its followers.", metavar="S")
    ] = 10.0,
    joins_s: Annotated[
        float, about("Seconds to wait until all followers have joined.", metavar="S")
    ] = 600.0,
    secret_file: SecretFile = None,
    on_lost: Annotated[
        Literal["go-on", "end"],
        about(
            "After a follower fails: drive its vehicles with the built-in driver, or end the run."
        ),
    ] = "go-on",
    own_ticks: Annotated[
        Literal["refuse", "ignore"],
        about("After a follower ticks the world itself: raise an error in it, or ignore the tick."),
    ] = "refuse",
    bad_controls: Annotated[
        Literal["error", "hold"],
        about("After invalid controls: raise an error, or keep the previous controls."),
    ] = "error",
    pace: Annotated[
        float | None,
        about(
            "Simulated seconds per second of real time [default: as fast as possible].", metavar="X"
        ),
    ] = None,
    rig: Annotated[
        Literal["none", "reference", "camera"],
        about("Mount the sensors that the reference driving stack needs.", panel=WORLD),
    ] = "none",
    deadline_s: Annotated[
        float | None,
        about(
            "With --pace: a step misses its deadline if it ends more than S seconds after it is "
            "due. Misses are counted by the phase in which the deadline passes [default: real time "
            "of one step].",
            "--deadline",
            metavar="S",
        ),
    ] = None,
    trace: Annotated[
        list[Path] | None,
        about(
            "Play recorded poses of other road users from a CSV file. Repeat it for more files.",
            "--trace",
            metavar="FILE",
            exists=True,
        ),
    ] = None,
    truth: Annotated[
        bool, flag("Give the true state of all vehicles to followers that request it.")
    ] = False,
    zones: Zones = None,
    backend: Backend = None,
    workers: Workers = None,
    record: RecordPath = None,
    record_also: RecordAlso = "",
    json_path: JsonPath = None,
) -> None:
    """Run a world whose agents are driven by programs that join over a socket.

    A program can also add its own vehicles, people and roadside units.
    """
    from cavmarl.cosim.actors.pose_traces import read_traces
    from cavmarl.cosim.followers.followed_world import FollowedWorld
    from cavmarl.cosim.stack.stack import RIGS
    from cavmarl.cosim.time_master import RealTime
    from cavmarl.env.parallel import parallel_env

    if followers < 0 or (steps is not None and steps < 1):
        raise ConfigError(
            f"--followers {followers}, --steps {steps}: --followers must be at least 0 and --steps "
            "at least 1"
        )
    if deadline_s is not None and pace is None:
        raise ConfigError(f"--deadline {deadline_s:g}: goes with --pace; add --pace 1")
    console = Console()
    traces = [one for path in trace or () for one in read_traces(path)]
    if rig in RIGS:
        given = {"clock.ctrl_dt_s": 0.05, "rig": RIGS[rig], **world.overrides}
        world = replace(world, overrides=given)
    made = parallel_env(
        world.env,
        zones=zones,
        backend=backend,
        workers=workers,
        record=recorded(record, record_also),
        **world.keywords,
    )
    with closing(made):
        pacer = None
        if pace is not None:
            step_s = made.step_s / pace if pace > 0.0 else made.step_s
            pacer = RealTime(pace, deadline_s=step_s if deadline_s is None else deadline_s)
        with FollowedWorld(
            made,
            address_of(at),
            secret=read_secret(secret_file, may_make=True),
            timeout_s=timeout_s,
            own_ticks=own_ticks,
            bad_controls=bad_controls,
            pacer=pacer,
            truth=truth,
            traces=traces,
        ) as led:
            console.print(f"waiting for {followers} followers at {led.address}", highlight=False)
            led.wait_for(followers, joins_s)
            found = run_episode(led, world.seed, steps, on_lost)
            if pacer is not None:
                found["lateness"] = vars(pacer.lateness)
            console.print(_table(found))
            if found["actors"]:
                console.print(_actor_table(found["actors"]))
            if pacer is not None and pacer.watch is not None:
                pacer.watch.end()
                found["deadline"] = pacer.watch.report()
                console.print(_deadline_text(found["deadline"]), highlight=False)
    write_json(json_path, found)


def run_episode(world: FollowedWorld, seed: int, steps: int | None, on_lost: str) -> dict[str, Any]:
    """Run one episode and return its figures; for the arguments, see `lead`."""
    master, lost = world.master, []

    def go_on(act: Callable[[], object]) -> None:
        try:
            act()
        except FollowerError as error:
            if on_lost == "end":
                raise
            print_error(f"{error} (the built-in driver drives its vehicles from here on)")
            lost.append(str(error))

    go_on(partial(world.reset, seed))
    first, per_step = master.tick, world.env.config.clock.ticks_per_step
    while not world.is_over and (done := (master.tick - first) // per_step) != steps:
        go_on(world.step)
    done = (master.tick - first) // per_step
    waited = sum(seat.wait_wall_s for seat in world.seats)
    return {
        **world.manifest(),
        "steps": done,
        "lost": lost,
        "time_s": master.time_s,
        "own_ticks": master.own_ticks,
        "state_hash": world.env.state_hash(),
        "traffic": world.env.traffic_stats(),
        "actors": world.actors.report(),
        "trace_steps_refused": world.player.refused,
        "barrier": [
            {
                "name": seat.clock.name,
                "answers": seat.answers,
                "late": seat.late,
                "bad": seat.bad,
                "wait_wall_s": seat.wait_wall_s,
                "wait_share": seat.wait_wall_s / waited if waited else 0.0,
                "slowest_in": seat.slowest,
                "unseen": seat.unseen,
            }
            for seat in world.seats
        ],
    }


def _table(found: dict[str, Any]) -> Table:
    rows = (
        (
            escape(row["name"]),
            *(str(row[name]) for name in ("answers", "late", "bad")),
            f"{row['wait_wall_s']:.2f}",
            str(row["slowest_in"]),
        )
        for row in found["barrier"]
    )
    heads = ("follower", "answers", "late", "invalid", "waited for, s", "slowest in, steps")
    return grid(heads, rows, f"{found['steps']} steps, {found['time_s']:g} s")


def _actor_table(actors: Sequence[dict[str, Any]]) -> Table:
    names = ("received", "late", "lost", "extrapolated", "stopped")
    rows = (
        (
            escape(f"{row['client']}: {row['name']}"),
            escape(row["type"]),
            *(str(row[name]) for name in names),
            f"{1e3 * row['worst_age_s']:.0f}",
        )
        for row in actors
    )
    heads = ("actor", "type", "poses", "late", "lost", "extrapolated", "stopped", "oldest, ms")
    return grid(heads, rows, "poses of actors; extrapolated, stopped: number of steps", lefts=2)


def _deadline_text(found: dict[str, Any]) -> str:
    share = f"{found['missed']} of {found['steps']} steps"
    phases = ", ".join(f"{phase} {count}" for phase, count in found["missed_in"].items())
    ended = f" ({phases}; at most {1e3 * found['worst_wall_s']:.1f} ms late)" if phases else ""
    return f"deadline of {1e3 * found['deadline_s']:g} ms missed in {share}{ended}"
