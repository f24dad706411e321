"""What `cavmarl verify --nodes` does and prints: worlds over nodes beside the undivided ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.markup import escape

from cavmarl.cli.output import grid, write_json
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.progress import counting


def verify_over_nodes(
    console: Console, world: WorldSpec, nodes: list[int], json_path: Path | None, **arguments: Any
) -> None:
    """Compare worlds over nodes with undivided ones; exit code 1 if anything differs."""
    from cavmarl.verify.node_losses import verify_nodes

    with counting(console, f"{world.env} over {', '.join(map(str, nodes))} nodes") as progress:
        found = verify_nodes(world, nodes, progress=progress, **arguments)
    write_json(json_path, found.to_dict())
    rows = [
        (
            str(run.nodes),
            str(run.killed),
            f"{run.migrations:,}",
            f"{run.step_ms:.3g}",
            " ".join(f"{ms:.0f}" for ms in run.recovery_ms) or "-",
            "equal" if run.different is None else f"different after step {run.different}",
        )
        for run in found.runs
    ]
    heads = ("nodes", "killed", "changes of owner", "step, ms", "recovery, ms", "")
    title = f"{escape(Path(found.env).name)}: {found.zones} zones, {found.steps} steps"
    console.print(grid(heads, rows, title))
    if not found.holds:
        raise typer.Exit(1)


CAMPAIGN, SIMULATED = "campaign", "simulated"


def verify_node_campaign(
    console: Console,
    world: WorldSpec,
    nodes: list[int],
    json_path: Path | None,
    faults: str,  # CAMPAIGN: simulated processes and real ones; SIMULATED: those alone
    steps: int | None,
    **arguments: Any,
) -> None:
    """Compare while connections and nodes fail; exit code 1 if anything differs."""
    given = arguments if steps is None else {**arguments, "steps": steps}
    found = {SIMULATED: _simulated(console, world, nodes, given)}
    if faults == CAMPAIGN:
        found["processes"] = _with_processes(console, world, nodes, given)
    write_json(json_path, found)
    if not all(one["holds"] for one in found.values()):
        raise typer.Exit(1)


def _simulated(
    console: Console, world: WorldSpec, nodes: list[int], given: dict[str, Any]
) -> dict[str, Any]:
    from cavmarl.verify.simulated_nodes import verify_simulated_nodes

    with counting(console, f"faults between simulated nodes of {world.env}") as progress:
        found = verify_simulated_nodes(world, nodes, progress=progress, **given)
    rows = [
        (
            str(line.nodes),
            line.faults,
            f"{line.runs:,}",
            f"{line.lost:,}",
            f"{line.back:,}",
            f"{line.ended:,}",
            f"{len(line.wrong)} wrong" if line.wrong else "equal",
        )
        for line in found.lines
    ]
    heads = ("nodes", "faults", "runs", "nodes lost", "recoveries", "ended", "")
    title = f"{escape(Path(found.env).name)}, simulated: {found.zones} zones, {found.steps} steps"
    console.print(grid(heads, rows, title))
    for line in found.lines:
        for text in line.wrong:
            console.print(f"{line.nodes} nodes, {line.faults}, {text}", markup=False, style="red")
    return found.to_dict()


def _with_processes(
    console: Console, world: WorldSpec, nodes: list[int], given: dict[str, Any]
) -> dict[str, Any]:
    from cavmarl.verify.node_faults import verify_node_faults

    with counting(console, f"faults between the nodes of {world.env}") as progress:
        found = verify_node_faults(world, nodes, progress=progress, **given)
    rows = [
        (
            str(line.nodes),
            line.fault,
            str(line.runs),
            str(line.done),
            str(line.lost),
            str(line.ended),
            f"different with seeds {line.different}" if line.different else "equal",
        )
        for line in found.lines
    ]
    heads = ("nodes", "fault", "runs", "faults", "nodes lost", "ended", "")
    title = f"{escape(Path(found.env).name)}, processes: {found.zones} zones, {found.steps} steps"
    console.print(grid(heads, rows, title))
    return found.to_dict()
