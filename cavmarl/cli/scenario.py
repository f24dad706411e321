"""`cavmarl scenario`: lists scenarios, and plays one to a driver."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Column, Table

from cavmarl.cli.output import JsonPath, about, about_file, number, with_world, write_json
from cavmarl.config.world_spec import WorldSpec, with_sensors_of_drivers
from cavmarl.core.errors import ConfigError
from cavmarl.core.progress import counting

if TYPE_CHECKING:
    from cavmarl.evaluate.scenarios.scenario_runs import ScenarioRun

WIDTH = 140  # of the table of a sweep, which goes into pages: it is never cut off

app = typer.Typer(help="Scripted conflicts for agents.", no_args_is_help=True)


@app.command("list")
def list_scenarios(json_path: JsonPath = None) -> None:
    """Show the scenarios, what each needs of a map, and its parameters."""
    from cavmarl.traffic.scenarios.library import load_scenario, scenario_names, summary_of
    from cavmarl.traffic.scenarios.scene import describe

    console = Console()
    document: dict[str, Any] = {}
    for name in scenario_names():
        scenario = load_scenario(name)
        table = Table("parameter", "default", "range", "what it is", box=box.SIMPLE_HEAD)
        rows = describe(scenario.Parameters)
        for row in rows:
            table.add_row(*map(escape, row))
        console.print(f"[bold]{name}[/bold]: {escape(summary_of(name))}")
        console.print(f"It needs {escape(scenario.NEEDS)}.")
        console.print(table)
        heads = ("name", "default", "range", "what")
        document[name] = {
            "summary": summary_of(name),
            "needs": scenario.NEEDS,
            "parameters": [dict(zip(heads, row, strict=True)) for row in rows],
        }
    write_json(json_path, document)


@app.command("run")
@with_world("agents", "seed", "settings", "sensors_of")
def run(
    world: WorldSpec,
    name: Annotated[str, typer.Argument(metavar="NAME", help="A scenario, or a .py file.")],
    env: Annotated[str, about("Name, folder or map file of an environment.", "--map")] = "grid4x4",
    place: Annotated[str, about("Place on the map; default: drawn by the seed.")] = "",
    param: Annotated[
        list[str] | None,
        about("A parameter of the scenario; may be repeated.", "--param", metavar="KEY=VALUE"),
    ] = None,
    driver: Annotated[str, about("Driver of the agents: a name, or a path.")] = "idm",
    agents: Annotated[
        int, about("Number of agents: one in the conflict, the others behind.", min=1)
    ] = 1,
    density: Annotated[str, about("Other traffic: none, low or high.")] = "none",
    zones: Annotated[
        int | None, about("Zones of the world; default: as the environment says.")
    ] = None,
    picture: Annotated[Path | None, about_file("Write a .png of the closest moment here.")] = None,
    video: Annotated[Path | None, about_file("Write an .mp4 of the run here.")] = None,
    json_path: JsonPath = None,
) -> None:
    """Play a scenario to a driver; exit code 1 unless all come through and hurt no one."""
    from cavmarl.evaluate.scenarios.scenario_films import ScenarioCamera
    from cavmarl.evaluate.scenarios.scenario_runs import make_scenario, run_scenario

    world = with_sensors_of_drivers(world, [driver])
    with ExitStack() as stack:
        vec = make_scenario(
            name, world, params=_params(param), place=place, density=density, zones=zones
        )
        stack.callback(vec.close)
        look: Callable[[], None] | None = None
        if picture is not None or video is not None:
            look = stack.enter_context(ScenarioCamera(vec, picture, video)).look
        found = run_scenario(vec, driver, world.seed, look)
    Console().print(_table(found))
    write_json(json_path, asdict(found))
    if not found.passed:
        raise typer.Exit(1)


@app.command("sweep")
def sweep(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME]...", help="Scenarios; default: all.")
    ] = None,
    map_names: Annotated[
        list[str] | None, about("An environment's map; may be repeated. Default: grid4x4.", "--map")
    ] = None,
    seeds: Annotated[int, about("Number of seeds, from 0 on.", min=1)] = 5,
    passes: Annotated[str, about("The driver that is to pass all.")] = "idm",
    fails: Annotated[str, about("The one that is to pass none.")] = "never_yield",
    density: Annotated[str, about("Other traffic: none, low or high.")] = "none",
    agents: Annotated[int, about("Agents in each world.", min=1)] = 1,
    json_path: JsonPath = None,
) -> None:
    """Play scenarios on maps to two drivers; exit code 1 unless one passes all, the other none."""
    from cavmarl.evaluate.scenarios.scenario_sweep import sweep_scenarios
    from cavmarl.traffic.scenarios.library import scenario_names

    heads = ("scenario", "map", passes, "least TTC, s", "least PET, s", fails)
    table = Table(*(Column(head, no_wrap=True) for head in heads), box=box.MARKDOWN)
    rows = []
    chosen, maps = names or scenario_names(), map_names or ["grid4x4"]
    keys: dict[str, Any] = {"passes": passes, "fails": fails, "density": density, "agents": agents}
    with counting(Console(), "scenarios") as told:
        found = []
        for row in sweep_scenarios(chosen, maps, range(seeds), **keys):
            found.append(row)
            told(len(found), len(chosen) * len(maps))
    for row in found:
        rows.append(row)
        cells = (
            f"`{row.scenario}`",
            Path(row.environment).stem,
            row.verdicts(row.passing) or "no place",
            number(row.least("min_ttc_s")),
            number(row.least("pet_s")),
            row.verdicts(row.failing) or "no place",
        )
        table.add_row(*map(escape, cells))
    Console(width=WIDTH).print(table)
    write_json(json_path, {"rows": [row.to_dict() for row in rows]})
    if not all(row.holds for row in rows):
        raise typer.Exit(1)


def _params(given: list[str] | None) -> dict[str, bool | float]:
    params: dict[str, bool | float] = {}
    for text in given or ():
        key, _, value = text.partition("=")
        try:
            read = json.loads(value)
        except ValueError:
            read = None
        if not key or not isinstance(read, bool | int | float):
            raise ConfigError(f"--param {text}: must be KEY=VALUE, a number, true or false")
        params[key] = read
    return params


def _table(found: ScenarioRun) -> Table:
    table = Table(show_header=False, box=box.SIMPLE)
    rows = {
        "scenario": f"{found.scenario} on {found.environment}, {found.place}",
        "driver": f"{found.driver} ({found.agents} agents), seed {found.seed}, "
        f"{found.background} others, {found.zones} zones",
        "verdict": ", ".join(found.verdicts) + (f"; failed: {found.clash}" if found.clash else ""),
        "least time to collision, s": number(found.min_ttc_s),
        "post-encroachment time, s": number(found.pet_s),
        "collisions": str(found.collisions),
        "junctions entered at red": str(found.red_lights),
        "delay, s": number(found.delay_s),
        "longest wait of others, s": number(found.longest_wait_s),
        "time, s": number(found.time_s),
        "state hash": found.state_hash,
    }
    for row in rows.items():
        table.add_row(*map(escape, row))
    return table
