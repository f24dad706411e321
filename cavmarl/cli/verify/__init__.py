"""`cavmarl verify`: whether divided worlds are the undivided one, bit for bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cavmarl.cli.output import (
    JsonPath,
    PolicyName,
    grid,
    make_folder,
    say_difference,
    with_world,
    write_json,
)
from cavmarl.cli.verify import options
from cavmarl.cli.verify.kills import verify_with_kills
from cavmarl.cli.verify.nodes import (
    CAMPAIGN,
    SIMULATED,
    verify_node_campaign,
    verify_over_nodes,
)
from cavmarl.config.world_spec import WorldSpec, with_sensors_of_drivers
from cavmarl.core.errors import ConfigError
from cavmarl.core.progress import counting

if TYPE_CHECKING:
    from cavmarl.verify.equivalence import Equivalence, ZoneResult

__all__ = ["verify"]


@with_world()
def verify(
    world: WorldSpec,
    env: options.Env = None,
    zones: options.Zones = None,
    steps: options.Steps = None,
    layout: options.Layout = None,
    policy: PolicyName = "idm",
    worlds: options.Worlds = None,
    faults: options.Faults = None,
    seeds: options.Seeds = 12,
    kill: options.Kill = None,
    nodes: options.Nodes = None,
    backend: options.Backend = None,
    workers: options.Workers = None,
    check: options.Check = False,
    journal: options.Journal = None,
    json_path: JsonPath = None,
) -> None:
    """Drive divided worlds beside the undivided one; exit code 1 and where one first differs.

    With --kill: worlds whose workers are killed beside undisturbed ones.
    """
    for option, value in (("--backend", backend), ("--workers", workers)):
        if value is not None and (kill is None or nodes is not None):
            raise ConfigError(f"{option} {value}: goes with --kill only, and without --nodes")
    counts = None if zones is None else _counts(zones)
    if env is not None:
        world = with_sensors_of_drivers(world, [policy])
    console = Console()
    checked = {"zones.check_invariants": True} if check else {}
    strict = replace(world, overrides={**world.overrides, **checked})
    if kill is not None or nodes is not None:
        known = nodes is not None and kill is None and faults in (CAMPAIGN, SIMULATED)
        plan = None if known else faults
        others = {"--faults": plan, "--layout": layout, "--journal": journal}
        _refuse_with_kill("--kill" if nodes is None else "--nodes", env, counts, others)
    run: dict[str, Any] = {"steps": steps, "policy": policy}
    one = None if counts is None else counts[0]
    if nodes is not None and faults is not None:
        if worlds is not None:
            raise ConfigError(f"--worlds {worlds}: a campaign has one world; leave it out")
        run |= {"faults": faults, "zones": one, "seeds": seeds}
        return verify_node_campaign(console, strict, _counts(nodes), json_path, **run)
    if kill is not None and nodes is None:
        run |= {"zones": one, "worlds": worlds, "backend": backend, "workers": workers}
        return verify_with_kills(console, strict, kill, json_path, **run)
    run |= {"worlds": 1 if worlds is None else worlds}
    if nodes is None and faults is not None:
        raise ConfigError(f"--faults {faults}: goes with --nodes only")
    run |= {"steps": 200 if steps is None else steps}
    if nodes is not None:
        run |= {"kills": kill or 0, "zones": one}
        return verify_over_nodes(console, strict, _counts(nodes), json_path, **run)
    if env is None:
        raise ConfigError("verify: name an environment")
    run |= {"layout": layout, "check": check, "journals": journal}
    return _verify_zones(console, world, env, counts, json_path, **run)


def _verify_zones(
    console: Console,
    world: WorldSpec,
    env: str,
    counts: list[int] | None,
    json_path: Path | None,
    **run: Any,
) -> None:
    """Divided worlds beside the undivided one: a table, and where one first differs."""
    if run["journals"] is not None:
        make_folder(run["journals"])
    from cavmarl.verify.equivalence import verify_zones

    with counting(console, f"{run['policy']} drives {env}, undivided and divided") as progress:
        found = verify_zones(world, counts, progress=progress, **run)
    write_json(json_path, found.to_dict())
    console.print(_table(found, world.seed))
    for result in found.results:
        if result.difference is not None:
            console.print(_sentence(result, found.worlds), markup=False, soft_wrap=True)
    if not found.holds:
        raise typer.Exit(1)
    hashes = ", ".join(found.state_hashes)
    console.print(f"state after tick {found.ticks}: {hashes}", highlight=False, soft_wrap=True)


_CURES = {
    "--faults": "worlds over nodes are verified with --faults simulated or campaign, those over "
    "workers without",
    "--layout": "use --set zones.layout=FILE",
    "--journal": "use --set zones.journal=FILE",
}


def _refuse_with_kill(
    what: str, env: str | None, counts: list[int] | None, others: dict[str, str | Path | None]
) -> None:
    if env is None:
        raise ConfigError(f"{what}: name an environment")
    if counts is not None and len(counts) > 1:
        raise ConfigError(f"--zones {','.join(map(str, counts))}: {what} takes one number of zones")
    for option, value in others.items():
        if value is not None:
            raise ConfigError(f"{option} {value}: does not go with {what}; {_CURES[option]}")


def _counts(text: str) -> list[int]:
    try:
        return [int(word) for word in text.split(",")]
    except ValueError:
        raise ConfigError(f"--zones {text}: must be numbers with commas between, 1,2,4") from None


def _table(found: Equivalence, seed: int) -> Table:
    many = "a world" if found.worlds == 1 else f"{found.worlds} worlds"
    rows = (
        (
            str(result.zones),
            str(result.steps),
            f"{result.vehicles:,.0f}",
            f"{result.crossings:,}",
            "[green]equal[/]" if result.difference is None else "[red]different[/]",
        )
        for result in found.results
    )
    title = escape(f"{Path(found.env).name}, {many}, seed {seed}: beside the undivided")
    return grid(("zones", "steps", "vehicles", "crossings", ""), rows, title, lefts=0)


def _sentence(result: ZoneResult, worlds: int) -> str:
    assert result.difference is not None
    where = f"{result.zones} zone{'' if result.zones == 1 else 's'}"
    if worlds > 1:
        where += f", world {result.world}"
    return f"{where}: {say_difference(result.difference, ('undivided', 'divided'))}"
