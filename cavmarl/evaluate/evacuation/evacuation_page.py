"""Writes the results of an evacuation as JSON and as a self-contained page."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import require
from cavmarl.evaluate.evacuation.evacuation_plan import edge_rows, roads_of
from cavmarl.evaluate.evacuation.evacuation_runs import (
    AreaResult,
    EvacuationResult,
    PreparedEvacuation,
)
from cavmarl.evaluate.provenance.manifest import write_text
from cavmarl.roads.network import RoadNetwork

_PAGE = Path(__file__).with_name("evacuation.html.j2")
RESULTS, PAGE = "results.json", "index.html"

FIGURES = {
    "vehicles": "vehicles",
    "arrived": "arrived",
    "unserved": "unserved",
    "clearance_50_s": "50 % cleared, s",
    "clearance_90_s": "90 % cleared, s",
    "clearance_s": "all cleared, s",
    "last_arrival_s": "last arrival, s",
    "left_by_s": "area left, s",
    "mean_trip_s": "mean trip, s",
}


def results_of(prepared: PreparedEvacuation, found: Sequence[EvacuationResult]) -> dict[str, Any]:
    """Return the plan, the map and all runs as plain values."""
    return {
        "plan": asdict(prepared.plan),
        "exits": list(prepared.exits),
        "map": prepared.network.name,
        "map_sha256": prepared.network.source_hash,
        "notes": list(prepared.evacuees.notes),
        "runs": [run.to_dict() for run in found],
    }


def write_results(
    prepared: PreparedEvacuation, found: Sequence[EvacuationResult], folder: Path
) -> None:
    """Write `results.json` and the page `index.html` to a folder.

    Raises MissingExtraError if matplotlib or Jinja2 is not installed.
    """
    require("matplotlib", "report")
    jinja2 = require("jinja2", "report")
    from cavmarl.evaluate import plots

    write_text(folder / RESULTS, json.dumps(results_of(prepared, found), indent=2) + "\n")
    template = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    ).from_string(_PAGE.read_text(encoding="utf-8"))
    plan, network = prepared.plan, prepared.network
    content = {
        "plan": plan,
        "exits": prepared.exits,
        "map": network.name,
        "notes": prepared.evacuees.notes,
        "heads": list(FIGURES.values()),
        "runs": [{"run": run, "rows": table_of(run)} for run in found],
        "roads": plots.plot_roads(_lines(network, None), _marked(prepared)),
        "trips": plots.plot_series(found[0].series, ("departed", "arrived"), "vehicles"),
        "queues": plots.plot_series(found[0].series, ("standing",), "standing vehicles"),
    }
    write_text(folder / PAGE, template.render(content))


def table_of(run: EvacuationResult) -> list[tuple[str, ...]]:
    """Return a row of cells for each area, and for all of them if there are several."""
    rows = list(run.areas.items())
    if len(rows) > 1:
        rows.append(("all areas", run.all))
    return [(name, *_cells(result)) for name, result in rows]


def _cells(result: AreaResult) -> tuple[str, ...]:
    values = (getattr(result, name) for name in FIGURES)
    return tuple("-" if value is None else f"{value:,.0f}" for value in values)


def _marked(prepared: PreparedEvacuation) -> dict[str, list[NDArray[np.float64]]]:
    """Return the lines of areas, exits, and roads whose state changes."""
    plan, network = prepared.plan, prepared.network
    found = {
        name: _lines(network, roads_of(area, name, network)) for name, area in plan.areas.items()
    }
    found["exits"] = _lines(network, edge_rows(prepared.exits, "exits", network))
    if plan.contraflow:
        rows = edge_rows(plan.contraflow, "contraflow", network)
        found["contraflow"] = _lines(network, rows)
    closed = sorted({edge for event in plan.events for edge in event.edges})
    if closed:
        found["events"] = _lines(network, edge_rows(closed, "events", network))
    return found


def _lines(network: RoadNetwork, edges: NDArray[np.intp] | None) -> list[NDArray[np.float64]]:
    """Return the centre lines (n, 2) in m of the lanes of some roads; None: of all roads."""
    lanes = network.lanes[~network.lanes["internal"]]
    if edges is not None:
        lanes = lanes[np.isin(lanes["edge"], edges)]
    points = np.stack([network.points["x"], network.points["y"]], axis=1)
    return [points[row["first_point"] :][: row["num_points"]] for row in lanes]
