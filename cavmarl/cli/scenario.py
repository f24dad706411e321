"""`cavmarl scenario`: lists scenarios and tests drivers in them."""

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

from cavmarl.cli.output import (
    VIDEO_EXTRAS,
    WINDOW_EXTRAS,
    WORLD,
    CliGroup,
    Imports,
    JsonPath,
    Zones,
    about,
    about_file,
    add_command,
    check_extras,
    number,
    parse_settings,
    with_world,
    write_json,
)
from cavmarl.config.world_spec import WorldSpec, with_sensors_of_drivers
from cavmarl.core.errors import ConfigError
from cavmarl.core.progress import counting

if TYPE_CHECKING:
    from cavmarl.evaluate.scenarios.scenario_runs import ScenarioRun

WIDTH = 140  # columns of the table of a sweep; it is pasted into pages and must not be cut off

app = typer.Typer(
    cls=CliGroup, help="List safety scenarios, and test drivers in them.", no_args_is_help=True
)


def list_scenarios(json_path: JsonPath = None) -> None:
    """List the scenarios with their parameters and requirements on the map."""
    from cavmarl.traffic.scenarios.library import load_scenario, scenario_names, summary_of
    from cavmarl.traffic.scenarios.scene import describe

    console = Console()
    document: dict[str, Any] = {}
    for name in scenario_names():
        scenario = load_scenario(name)
        table = Table("parameter", "default", "range", "description", box=box.SIMPLE_HEAD)
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


@with_world("agents", "seed", "settings", "sensors_of")
def run(
    world: WorldSpec,
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of a scenario, or a .py file.")],
    env: Annotated[
        str,
        about(
            "Environment: its name, its folder, a map file or a .sumocfg.",
            "--map",
            metavar="ENV",
            panel=WORLD,
        ),
    ] = "grid4x4",
    place: Annotated[
        str,
        about(
            "Place on the map, as an earlier run prints it [default: drawn by the seed].",
            metavar="PLACE",
        ),
    ] = "",
    param: Annotated[
        list[str] | None,
        about(
            "Set a parameter of the scenario. Repeat it for more.", "--param", metavar="KEY=VALUE"
        ),
    ] = None,
    driver: Annotated[
        str, about("Driver of the agents: a name, a .py file or a folder.", metavar="POLICY")
    ] = "idm",
    agents: Annotated[
        int,
        about(
            "Number of agents: one in the conflict, the others behind it.",
            metavar="N",
            min=1,
            panel=WORLD,
        ),
    ] = 1,
    density: Annotated[
        str, about("Density of other traffic: none, low or high.", metavar="DENSITY")
    ] = "none",
    zones: Zones = None,
    picture: Annotated[
        Path | None, about_file("Draw the closest moment to this .png file.")
    ] = None,
    video: Annotated[Path | None, about_file("Write a video of the run to this .mp4 file.")] = None,
    json_path: JsonPath = None,
) -> None:
    """Test a driver in a scenario.

    If an agent does not reach its goal, or causes a collision, exit with 1.
    """
    check_extras(world, [driver], (picture, WINDOW_EXTRAS), (video, VIDEO_EXTRAS))
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


def sweep(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="NAME", help="Names of scenarios.", show_default="all"),
    ] = None,
    map_names: Annotated[
        list[str] | None,
        about(
            "Environment or map file. Repeat it for more [default: grid4x4].",
            "--map",
            metavar="ENV",
        ),
    ] = None,
    seeds: Annotated[int, about("Number of seeds, starting from 0.", metavar="N", min=1)] = 5,
    passes: Annotated[str, about("Driver that must pass every run.", metavar="POLICY")] = "idm",
    fails: Annotated[
        str, about("Driver that must fail every run.", metavar="POLICY")
    ] = "never_yield",
    density: Annotated[
        str, about("Density of other traffic: none, low or high.", metavar="DENSITY")
    ] = "none",
    agents: Annotated[int, about("Number of agents in each world.", metavar="N", min=1)] = 1,
    imports: Imports = None,
    json_path: JsonPath = None,
) -> None:
    """Test two drivers in many scenarios and maps.

    If the first driver does not pass all runs, or the second passes one, exit with 1.
    """
    from cavmarl.evaluate.scenarios.scenario_sweep import sweep_scenarios
    from cavmarl.traffic.scenarios.library import scenario_names

    heads = ("scenario", "map", passes, "least TTC, s", "least PET, s", fails)
    table = Table(*(Column(head, no_wrap=True) for head in heads), box=box.MARKDOWN)
    rows = []
    chosen, maps = names or scenario_names(), map_names or ["grid4x4"]
    keys: dict[str, Any] = {"passes": passes, "fails": fails, "density": density, "agents": agents}
    keys["overrides"] = parse_settings(None, imports)
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


@with_world("agents", "seed", "settings", "sensors_of")
def realism(
    world: WorldSpec,
    env: Annotated[
        str,
        typer.Argument(
            metavar="SCENE",
            help="Scene file (.pkl of ScenarioNet, .json of GPUDrive), or an environment with one.",
        ),
    ],
    param: Annotated[
        list[str] | None,
        about("Set a parameter of the scene. Repeat it for more.", "--param", metavar="KEY=VALUE"),
    ] = None,
    driver: Annotated[
        str, about("Driver of the agents: a name, a .py file or a folder.", metavar="POLICY")
    ] = "idm",
    agents: Annotated[
        int | None,
        about(
            "Number of agents [default: as configured; 1 for a scene file].",
            metavar="N",
            min=1,
            panel=WORLD,
        ),
    ] = None,
    rollouts: Annotated[int, about("Number of rollouts.", metavar="N", min=1)] = 32,
    json_path: JsonPath = None,
) -> None:
    """Measure how realistic rollouts of a logged scene are.

    The meta-metric of the Waymo Open Sim Agents Challenge 2024 covers the vehicles of agents
    and, with --param reactive=true, of built-in drivers.
    """
    check_extras(world, [driver])
    from cavmarl.evaluate.realism.logged_rollouts import measure_realism
    from cavmarl.evaluate.realism.realism_metric import COMPONENTS, YEAR

    world = with_sensors_of_drivers(world, [driver])
    overrides = dict(world.overrides)
    if param:
        overrides["scenario.params"] = _params(param)
    with counting(Console(), "steps") as told:
        found = measure_realism(
            env,
            driver,
            rollouts=rollouts,
            agents=agents,
            seed=world.seed,
            overrides=overrides,
            told=told,
        )
    table = Table("component", "weight", "likelihood", box=box.SIMPLE_HEAD)
    for name, value in found.realism.likelihoods.items():
        table.add_row(name, f"{COMPONENTS[name].weight:g}", f"{value:.4f}")
    for name, value in found.realism.buckets.items():
        table.add_row(f"all {name}", "", f"{value:.4f}")
    table.add_row(f"meta-metric ({YEAR})", "", f"{found.realism.meta:.4f}")
    console = Console()
    console.print(
        f"{escape(found.scene)}: {found.rollouts} rollouts of {found.steps} steps with "
        f"{escape(driver)}, seed {found.seed}; {found.evaluated} vehicles driven, "
        f"{found.replayed} road users replayed"
    )
    console.print(table)
    console.print(
        f"mean distance from the log {found.ade_m:.2f} m, in the best rollout "
        f"{found.min_ade_m:.2f} m; {found.missing_percent:.1f} % of the logged steps are missing, "
        "because vehicles had left"
    )
    write_json(json_path, found.to_dict())


def _params(given: list[str] | None) -> dict[str, bool | float]:
    params: dict[str, bool | float] = {}
    for text in given or ():
        key, _, value = text.partition("=")
        try:
            read = json.loads(value)
        except ValueError:
            read = None
        if not key or not isinstance(read, bool | int | float):
            raise ConfigError(
                f"--param {text}: must be KEY=VALUE with a number, true or false as the value"
            )
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


add_command(app, "list", list_scenarios, "cavmarl scenario list")
add_command(
    app,
    "run",
    run,
    "cavmarl scenario run merge_conflict --map grid4x4 --driver idm --video merge_conflict.mp4",
)
add_command(
    app,
    "realism",
    realism,
    "cavmarl scenario realism scene.json --driver idm --param reactive=true --rollouts 32",
)
add_command(
    app,
    "sweep",
    sweep,
    "cavmarl scenario sweep merge_conflict --map grid4x4 --seeds 5",
)
