"""`cavmarl evacuate`: evacuates areas of a map, and writes a page."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from shutil import rmtree
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape

from cavmarl.cli.output import (
    PAGE_EXTRAS,
    Backend,
    JsonPath,
    NewFolder,
    Seed,
    Workers,
    Zones,
    about,
    backend_text,
    grid,
    make_folder,
    results_folder,
    write_json,
)
from cavmarl.core.errors import CavmarlError, ConfigError, require_all
from cavmarl.core.progress import counting

if TYPE_CHECKING:
    from cavmarl.evaluate.evacuation.evacuation_plan import EvacuationPlan
    from cavmarl.roads.network import RoadNetwork

VEHICLES = 300
PLAN_FILES = (".yaml", ".yml")


def evacuate(
    where: Annotated[
        str,
        typer.Argument(
            metavar="MAP|PLAN",
            help="Map file, environment, or evacuation plan (.yaml).",
        ),
    ],
    vehicles: Annotated[
        int | None,
        about(
            f"Number of vehicles on a map without a plan [default: {VEHICLES}].",
            metavar="N",
            min=1,
        ),
    ] = None,
    around: Annotated[
        str | None,
        about("Centre of the area, in m [default: the centre of the roads].", metavar="X,Y"),
    ] = None,
    radius: Annotated[
        float | None,
        about("Radius of the area in m [default: 40 % of the map's radius].", metavar="M", min=1.0),
    ] = None,
    exits: Annotated[
        list[str] | None,
        about(
            "Road by which vehicles leave; repeat it for more [default: distant dead ends].",
            "--exit",
            metavar="EDGE",
        ),
    ] = None,
    contraflow: Annotated[
        list[str] | None,
        about("Road that is reversed; repeat it for more.", metavar="EDGE"),
    ] = None,
    close: Annotated[
        list[str] | None,
        about("Road that the evacuation closes; repeat it for more.", metavar="EDGE"),
    ] = None,
    within_s: Annotated[
        float | None, about("Seconds in which all vehicles depart.", metavar="S", min=0.0)
    ] = None,
    seconds: Annotated[float | None, about("Maximum simulated time.", metavar="S", min=1.0)] = None,
    repeats: Annotated[
        int, about("Number of runs, with consecutive seeds.", "--repeats", "-r", metavar="N", min=1)
    ] = 1,
    seed: Seed = 0,
    zones: Zones = None,
    backend: Backend = None,
    workers: Workers = None,
    out: NewFolder = None,
    json_path: JsonPath = None,
) -> None:
    """Evacuate areas of a map through exits, and write a page with clearance times.

    In the results, the folder of each run is an environment for `make_vec`.
    """
    require_all(PAGE_EXTRAS)
    from cavmarl.engine.world_setup import load_world
    from cavmarl.evaluate.evacuation.evacuation_page import (
        FIGURES,
        PAGE,
        results_of,
        table_of,
        write_results,
    )
    from cavmarl.evaluate.evacuation.evacuation_plan import load_plan
    from cavmarl.evaluate.evacuation.evacuation_runs import prepare, run_evacuation

    if Path(where).suffix in PLAN_FILES:
        given = {"--vehicles": vehicles, "--around": around, "--radius": radius}
        for option, value in given.items():
            if value is not None:
                raise ConfigError(f"{option}: a plan has its own areas; change {where} instead")
        plan, base = load_plan(Path(where)), Path(where).parent
    else:
        count = VEHICLES if vehicles is None else vehicles
        base = Path()
        network = load_world(where, agents=0, background=0).network  # read only once
        plan = _plan_of_map(where, network, count, around, radius)
    plan = _changed(plan, exits, contraflow, close, within_s, seconds)
    folder = results_folder(out, "evacuate", where)
    was_there = folder.exists()
    make_folder(folder)
    console = Console()
    found = []
    for number in range(seed, seed + repeats):
        place = folder / f"seed-{number}"
        make_folder(place)
        try:
            prepared = prepare(plan, base, place, number)
        except CavmarlError:
            if number == seed:  # no earlier run has written results
                rmtree(place if was_there else folder)
            raise
        if number == seed:
            if not plan.exits:
                console.print(f"exits, chosen: {escape(', '.join(prepared.exits))}")
            for note in prepared.evacuees.notes:
                console.print(f"left out: {escape(note)}")
        with counting(console, f"arrivals, seed {number}") as told:
            run = run_evacuation(
                prepared,
                seed=number,
                zones=zones,
                backend=backend_text(backend, workers),
                told=told,
            )
        found.append(run)
        if run.contacts:
            places = escape(", ".join(run.contact_places) or "unknown roads (between samples)")
            console.print(f"contacts: {run.contacts}, on {places}")
        for road in (road for road, count in run.contraflow.items() if not count):
            console.print(f"contraflow: no vehicle used the lanes on {escape(road)}")
        names, *columns = zip(*table_of(run), strict=True)
        rows = [(title, *cells) for title, cells in zip(FIGURES.values(), columns, strict=True)]
        console.print(grid((f"seed {number}", *map(escape, names)), rows))
    write_results(prepared, found, folder)
    write_json(json_path, results_of(prepared, found))
    console.print(f"page: {folder / PAGE}", highlight=False)


def _plan_of_map(
    where: str, network: RoadNetwork, vehicles: int, around: str | None, radius_m: float | None
) -> EvacuationPlan:
    """Return a plan for one area of a map: a circle."""
    from cavmarl.evaluate.evacuation.evacuation_plan import AREA, EvacuationPlan, circle, middle_of

    x, y, own_radius_m = middle_of(network)
    if around is not None:
        try:
            x, y = map(float, around.split(","))
        except ValueError:
            raise ConfigError(
                f"--around {around}: must be X,Y in m of the map's frame, for example 120,450"
            ) from None
    area = circle(x, y, own_radius_m if radius_m is None else radius_m, vehicles)
    name = str(Path(where).resolve()) if Path(where).is_file() else where
    return EvacuationPlan(map=name, areas={AREA: area})


def _changed(
    plan: EvacuationPlan,
    exits: list[str] | None,
    contraflow: list[str] | None,
    close: list[str] | None,
    within_s: float | None,
    seconds: float | None,
) -> EvacuationPlan:
    """Return the plan with the values of the given options."""
    from cavmarl.config.road_events import RoadEvent

    more: tuple[RoadEvent, ...] = ()
    if close:
        more = (RoadEvent(at_s=plan.start_s, action="close", edges=tuple(close), shuts_in=True),)
    return replace(
        plan,
        exits=tuple(exits) if exits else plan.exits,
        contraflow=tuple(contraflow) if contraflow else plan.contraflow,
        within_s=plan.within_s if within_s is None else within_s,
        horizon_s=plan.horizon_s if seconds is None else seconds,
        events=(*plan.events, *more),
    )
