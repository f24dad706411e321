"""`cavmarl bench`: how fast it is, as ratios measured side by side in one run."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from cavmarl.cli.bench.balance import balance
from cavmarl.cli.bench.clock import clock
from cavmarl.cli.bench.libraries import libraries
from cavmarl.cli.bench.moving import moving
from cavmarl.cli.bench.rays import rays
from cavmarl.cli.bench.recut import recut
from cavmarl.cli.bench.sensors import sensors
from cavmarl.cli.bench.sharding import sharding
from cavmarl.cli.bench.sumo import sumo
from cavmarl.cli.bench.traffic import traffic
from cavmarl.cli.bench.train import train
from cavmarl.cli.bench.v2x import v2x
from cavmarl.cli.bench.workers import workers
from cavmarl.cli.output import (
    Agents,
    Background,
    Environment,
    JsonPath,
    Seed,
    Settings,
    parse_settings,
    write_json,
)
from cavmarl.core.errors import ConfigError

if TYPE_CHECKING:
    from cavmarl.bench.step_profile import StepProfile
    from cavmarl.bench.step_speed import Row, StepSpeed
    from cavmarl.env.vector import CavVectorEnv

__all__ = ["app"]

app = typer.Typer(help="How fast it is, measured side by side.", no_args_is_help=True)
app.command()(traffic)
app.command()(sumo)
app.command()(sharding)
app.command()(balance)
app.command()(moving)
app.command()(recut)
app.command()(workers)
app.command()(train)
app.command()(rays)
app.command()(sensors)
app.command()(v2x)
app.command()(libraries)
app.command()(clock)

_SENSORS = {"lidar": "64 rays", "kinematics": "no rays", "puffer_drive": "pufferlib's"}
_WHO = {
    "dicts": "cavmarl, dicts",
    "highway_env": "highway-env",
    "highway_env_raw": "highway-env, raw",
    "copied": "cavmarl, copied",
    "c": "peer in C, -O2",
    "c_native": "peer in C, -O3, native",
}


@app.command()
def step(
    agents: Annotated[int, typer.Option(help="Controlled vehicles a world.")] = 100,
    worlds: Annotated[int, typer.Option(help="Of ours, stepped together.")] = 16,
    repeats: Annotated[int, typer.Option(help="Measurements of each, by turns.")] = 5,
    peer: Annotated[
        bool, typer.Option("--peer", help="With pufferlib's observation beside a peer in C, too.")
    ] = False,
    at_least: Annotated[
        float | None, typer.Option(help="Exit with 1 if the ratio with a lidar is below this.")
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Agent-steps a second next to highway-env's: same road, vehicles and rates; one core."""
    from cavmarl.bench.step_speed import measure_step_speed

    if at_least is not None and not 0.0 < at_least < math.inf:
        raise ConfigError(f"--at-least {at_least:g}: must be a number above 0")
    console = Console()
    with console.status("") as status:
        found = measure_step_speed(agents, worlds, repeats, peer, status.update)
    console.print(_speed_table(found))
    console.print(
        f"batched over highway-env: [bold]{found.ratio:,.0f}[/] with a lidar, "
        f"[bold]{found.ratio_kinematics:,.0f}[/] without "
        f"({found.ratio_kinematics_raw:,.0f} over its raw observation)\n"
        f"an agent among ten times as many costs [bold]{found.cost_of_more:.2f}[/] times as much; "
        f"dicts add [bold]{found.dict_us:.2f} µs[/] an agent and step"
    )
    if found.ratio_peer is not None:
        console.print(
            f"with pufferlib's observation, batched over the peer in C: "
            f"[bold]{found.ratio_peer:.2f}[/] ({found.ratio_peer_native:.2f} over its native build)"
        )
    write_json(json_path, found.to_dict())
    if at_least is not None and found.ratio < at_least:
        raise typer.Exit(1)


def _speed_table(found: StepSpeed) -> Table:
    agents = found.rows[0].agents
    table = Table(
        "observation",
        "",
        title=(
            f"agent-steps/s of one core: {agents} controlled vehicles on "
            f"{found.road_m / 1000.0:.1f} km of four lanes,\n"
            "two ticks a step (pufferlib's: one); ours with 16 neighbours too; "
            f"{found.repeats} turns"
        ),
    )
    for column in ("agents", "min", "median", "max"):
        table.add_column(column, justify="right")
    shown = ""
    for row in sorted(found.rows, key=lambda row: list(_SENSORS).index(row.sensors)):
        table.add_row(
            "" if row.sensors == shown else _SENSORS[row.sensors],
            _who(row),
            f"{row.agents:,}",
            *(f"{rate:,.0f}" for rate in (row.low, row.median, row.high)),
        )
        shown = row.sensors
    return table


def _who(row: Row) -> str:
    return _WHO.get(row.who, f"cavmarl, {row.worlds} world{'' if row.worlds == 1 else 's'}")


@app.command()
def profile(
    env: Environment,
    agents: Agents = None,
    background: Background = None,
    worlds: Annotated[int, typer.Option(help="Stepped together.")] = 16,
    steps: Annotated[int, typer.Option(help="Steps a turn.")] = 200,
    repeats: Annotated[int, typer.Option(help="Turns; the fastest counts.")] = 5,
    seed: Seed = 0,
    settings: Settings = None,
    json_path: JsonPath = None,
) -> None:
    """Where the time of a step goes: the processor's nanoseconds a vehicle, phase by phase."""
    from cavmarl.bench.step_profile import profile_step
    from cavmarl.env.vector import make_vec

    overrides = parse_settings(settings)

    def make() -> CavVectorEnv:
        return make_vec(
            env, num_envs=worlds, agents=agents, background=background, overrides=overrides
        )

    console = Console()
    with console.status("measuring"):
        found = profile_step(make, steps, seed, repeats)
    console.print(_profile_table(found))
    console.print(
        f"a step without stopwatches: [bold]{found.plain_ns:,.0f}[/] ns a vehicle; the phases sum "
        f"to {found.timed_ns / found.plain_ns - 1.0:+.1%} of that"
    )
    write_json(json_path, found.to_dict())


def _profile_table(found: StepProfile) -> Table:
    table = Table(
        "phase",
        title=(
            f"{found.vehicles:,.0f} vehicles, {found.agents:,.0f} of them agents; "
            f"{found.ticks_per_step} ticks a step"
        ),
    )
    table.add_column("ns a vehicle and step", justify="right")
    table.add_column("share", justify="right")
    for name, ns in found.phases.items():
        table.add_row(name, f"{ns:,.0f}", f"{ns / found.timed_ns:.1%}")
    table.add_section()
    table.add_row("sum", f"{found.timed_ns:,.0f}", "100 %")
    return table
