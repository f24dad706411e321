"""`cavmarl verify nodes`: checks worlds over node processes, also while processes fail."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from cavmarl.bench.harness import numbers_of
from cavmarl.cli.output import JsonPath, PolicyName, about, grid, pairs_grid, with_world, write_json
from cavmarl.cli.verify import options
from cavmarl.config.world_spec import WorldSpec, with_sensors_of_drivers
from cavmarl.core.errors import ConfigError
from cavmarl.core.progress import counting

if TYPE_CHECKING:
    from cavmarl.verify.fault_campaign import FaultCampaign, FaultLine

SIMULATED, PROCESSES, CAMPAIGN = "simulated", "processes", "campaign"
NODES = "2,3,4"
STEPS, SEEDS, PROCESS_RUNS = 200, 65, 3

Env = Annotated[
    str | None,
    typer.Argument(
        metavar="ENV",
        help="Environment: its name, its folder, a map file or a .sumocfg.",
        show_default="with --faults: a busy grid4x4",
    ),
]
Nodes = Annotated[str, about("Numbers of node processes to compare.", "--nodes", metavar="N,N,…")]
Kill = Annotated[
    int | None,
    about("Kill N nodes at random times; at least one node must remain.", metavar="N"),
]
Faults = Annotated[
    str | None,
    about(
        f"Inject faults: {SIMULATED} runs the code of the nodes on a simulated machine, "
        f"{PROCESSES} kills real processes and breaks their connections, {CAMPAIGN} does both.",
        metavar="|".join((SIMULATED, PROCESSES, CAMPAIGN)),
    ),
]
Mix = Annotated[
    str | None,
    about(
        "On the simulated machine: the kinds of faults, as in docs/explanation/faults.md "
        "[default: all].",
        metavar="NAME,…",
    ),
]
Seeds = Annotated[
    int | None,
    about(
        "On the simulated machine: number of runs for each number of nodes and kind of fault "
        f"[default: {SEEDS}].",
        metavar="N",
    ),
]
FirstSeed = Annotated[
    int | None,
    about("Seed of the faults of the first run [default: 0].", metavar="N"),
]
ProcessRuns = Annotated[
    int | None,
    about(
        "With real processes: number of runs for each number of nodes and kind of fault "
        f"[default: {PROCESS_RUNS}].",
        metavar="N",
    ),
]


@with_world()
def verify_nodes(
    world: WorldSpec,
    env: Env = None,
    nodes: Nodes = NODES,
    zones: options.ZoneCount = None,
    steps: Annotated[
        int | None,
        about(
            f"Number of steps to compare [default: {STEPS}; with --faults 16, with processes "
            "40 or more].",
            metavar="N",
        ),
    ] = None,
    worlds: Annotated[
        int | None,
        about("Number of parallel worlds [default: 1; with --faults always 1].", metavar="N"),
    ] = None,
    policy: PolicyName = "idm",
    check: options.Check = False,
    kill: Kill = None,
    faults: Faults = None,
    mix: Mix = None,
    seeds: Seeds = None,
    first_seed: FirstSeed = None,
    process_runs: ProcessRuns = None,
    json_path: JsonPath = None,
) -> None:
    """Compare a world over node processes with the undivided one, step by step.

    On the first different result or state, print it and exit with 1.
    """  # fmt: skip
    counts = numbers_of("--nodes", nodes)
    runs: dict[str, Any] = {"zones": zones, "policy": policy}
    of_faults = {
        "--mix": mix, "--seeds": seeds, "--first-seed": first_seed, "--process-runs": process_runs,
    }  # fmt: skip
    if faults is None:
        _refuse(of_faults, "goes with --faults")
        if env is None:
            raise ConfigError("verify nodes: name an environment; only --faults has a default")
        world = _checked(with_sensors_of_drivers(world, [policy]), check)
        runs |= {"kills": kill or 0, "worlds": worlds or 1, "steps": steps or STEPS}
        return _compare(Console(), world, counts, json_path, runs)
    _refuse({"--kill": kill, "--worlds": worlds}, "does not go with --faults")
    if faults not in (SIMULATED, PROCESSES, CAMPAIGN):
        raise ConfigError(f"--faults {faults}: must be {SIMULATED}, {PROCESSES} or {CAMPAIGN}")
    if faults == SIMULATED:
        _refuse({"--process-runs": process_runs}, f"goes with {PROCESSES} or {CAMPAIGN}")
    if faults == PROCESSES:
        _refuse({"--mix": mix, "--seeds": seeds}, f"goes with {SIMULATED} or {CAMPAIGN}")
    if env is None:
        world = _busy(world)
    world = _checked(with_sensors_of_drivers(world, [policy]), check)
    runs |= {} if steps is None else {"steps": steps}
    runs |= {} if first_seed is None else {"first_seed": first_seed}
    console, found = Console(), dict[str, Any]()
    if faults != PROCESSES:
        mixes = {} if mix is None else {"mixes": mix.split(",")}
        simulated = runs | mixes | {"seeds": SEEDS if seeds is None else seeds}
        found[SIMULATED] = _simulated(console, world, counts, simulated)
    if faults != SIMULATED:
        real = runs | {"seeds": PROCESS_RUNS if process_runs is None else process_runs}
        found[PROCESSES] = _processes(console, world, counts, real)
    holds = all(part["holds"] for part in found.values())
    write_json(json_path, {**found, "holds": holds})
    if not holds:
        raise typer.Exit(1)


def _refuse(given: dict[str, Any], why: str) -> None:
    for option, value in given.items():
        if value is not None:
            raise ConfigError(f"{option} {value}: {why}")


def _checked(world: WorldSpec, check: bool) -> WorldSpec:
    checked = {"zones.check_invariants": True} if check else {}
    return replace(world, overrides={**world.overrides, **checked})


def _busy(world: WorldSpec) -> WorldSpec:
    """Return the default world of a campaign, in which many vehicles change their zone."""
    from cavmarl.verify.simulated_nodes import BUSY

    return replace(BUSY, seed=world.seed, overrides={**BUSY.overrides, **world.overrides})


def _compare(
    console: Console,
    world: WorldSpec,
    nodes: list[int],
    json_path: Path | None,
    runs: dict[str, Any],
) -> None:
    """Compare worlds over nodes with undivided ones; on a difference, exit with 1."""
    from cavmarl.verify import node_losses

    with counting(console, f"{world.env} over {', '.join(map(str, nodes))} nodes") as progress:
        found = node_losses.verify_nodes(world, nodes, progress=progress, **runs)
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


def _simulated(
    console: Console, world: WorldSpec, nodes: list[int], runs: dict[str, Any]
) -> dict[str, Any]:
    """Inject faults on the simulated machine; print the results and how to repeat wrong runs."""
    from cavmarl.verify.simulated_nodes import verify_simulated_nodes

    with counting(console, f"faults between simulated nodes of {world.env}") as progress:
        found = verify_simulated_nodes(world, nodes, progress=progress, **runs)
    figures = _shown(console, found, SIMULATED)
    for line in found.lines:
        for seed in line.wrong_seeds:
            again = _again(world, found, line, seed, str(runs["policy"]))
            console.print(f"to repeat this run: {again}", markup=False, soft_wrap=True)
    return figures


def _again(
    world: WorldSpec, found: FaultCampaign[Any], line: FaultLine, seed: int, policy: str
) -> str:
    """Return the command that repeats one run of a campaign."""
    words = ["cavmarl", "verify", "nodes", world.env, "--faults", SIMULATED]
    words += ["--nodes", str(line.nodes), "--mix", line.kind, "--policy", policy]
    words += ["--first-seed", str(seed), "--seeds", "1"]
    words += ["--zones", str(found.zones), "--steps", str(found.steps), "--seed", str(world.seed)]
    for option, value in (("--agents", world.agents), ("--background", world.background)):
        words += [] if value is None else [option, str(value)]
    for key, value in world.overrides.items():
        words += ["--set", f"{key}={value if isinstance(value, str) else json.dumps(value)}"]
    return shlex.join(words)


def _processes(
    console: Console, world: WorldSpec, nodes: list[int], runs: dict[str, Any]
) -> dict[str, Any]:
    """Inject faults with real processes; print the results."""
    from cavmarl.verify.node_faults import verify_node_faults

    with counting(console, f"faults between the nodes of {world.env}") as progress:
        found = verify_node_faults(world, nodes, progress=progress, **runs)
    return _shown(console, found, PROCESSES)


def _shown(console: Console, found: FaultCampaign[Any], place: str) -> dict[str, Any]:
    """Print a table, figures and wrong runs of a campaign; return the figures."""
    rows = [
        (
            str(line.nodes),
            line.kind,
            f"{line.runs:,}",
            f"{line.injected.total():,}",
            f"{line.deaths:,}",
            f"{line.recoveries:,}",
            f"{line.ended:,}",
            f"{len(line.wrong)} wrong" if line.wrong else "equal",
        )
        for line in found.lines
    ]
    heads = ("nodes", "kind", "runs", "faults", "deaths", "recoveries", "ended", "")
    title = f"{escape(Path(found.env).name)}, {place}: {found.zones} zones, {found.steps} steps"
    console.print(grid(heads, rows, title, lefts=2))
    figures = found.to_dict()
    _print_figures(console, figures)
    for line in found.lines:
        for seed, text in zip(line.wrong_seeds, line.wrong, strict=True):
            where = f"{line.nodes} nodes, {line.kind}, seed {seed}"
            console.print(f"{where}: {text}", markup=False, soft_wrap=True, style="red")
    return figures


def _print_figures(console: Console, figures: dict[str, Any]) -> None:
    names = {
        "runs": "runs",
        "equal": "equal to the undivided world",
        "ended": "ended with WorkerDeathError",
        "caller_ended": "ended with their caller",
        "wrong": "wrong",
        "faults": "injected faults",
        "deaths": "deaths of processes",
        "recoveries": "recoveries",
        "replacements": "replaced nodes",
        "migrations": "changes of owner",
    }
    rows = [(text, f"{figures[name]:,}") for name, text in names.items() if name in figures]
    kinds = ", ".join(f"{kind} {num:,}" for kind, num in figures["injected"].items())
    console.print(pairs_grid([*rows, ("by kind", kinds or "none")]))
