"""Replays a tick that no host survived: does it fail as it did, and does it without faults?"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import gettempdir

from cavmarl.config.env import EnvConfig
from cavmarl.config.io import validate
from cavmarl.config.registry import find_entry
from cavmarl.core.errors import JournalError
from cavmarl.engine.simulation import Simulation
from cavmarl.engine.world_setup import World, make_world
from cavmarl.handoff.fault_injection.fault_plan import Faults
from cavmarl.handoff.fault_injection.reproducer_file import Reproducer
from cavmarl.handoff.fault_injection.reproducer_recording import made_with, sources_of


def world_of(kept: Reproducer, env: str | Path | None = None) -> World:
    """The world that a reproducer is of; other roads, demand or zones are refused.

    They are found where `env` says, as `make_vec` takes it; None: by its environment's name.
    """
    config = validate(EnvConfig, kept.config, "the reproducer")
    found = find_entry(config.name if env is None else env)
    world = make_world(config, found if found.is_dir() else found.parent)
    here = sources_of(world.network, world.demand, world.partition)
    for name, known in kept.sources.items():
        if here.get(name) != known:
            raise JournalError(
                f"the {name} of {found} is not the one that the tick was run with; name the "
                "environment that has it"
            )
    return world


def replay_tick(kept: Reproducer, world: World, *, faults: bool = True) -> str:
    """Run the tick again in this process, and tell the hash of the state that it leads to.

    With `faults` those of its plan strike, if it had one. Without them, whatever a zone's code
    raises is raised from where it is.

    Raises:
        LostTickError: every host of a zone, or every coordinator, dies of it again.
    """
    config = world.config
    if faults:  # hosts may die as they did, wherever the folder was; nothing is written
        zones = replace(config.zones, reproducers=gettempdir())
    else:
        zones = replace(config.zones, reproducers="", faults=Faults().to_json())  # messages alone
    simulation = Simulation(
        replace(config, zones=zones), world.network, 1, world.demand, world.partition
    )
    simulation.resume(kept)
    simulation.run_tick(kept.commands, kept.is_first, kept.is_last)
    return simulation.state_hash()


def changed_versions(kept: Reproducer) -> list[str]:
    here = made_with()
    return [
        f"{name} {there}, here {here.get(name)}"
        for name, there in kept.made_with.items()
        if here.get(name) != there
    ]
