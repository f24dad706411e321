"""Only the owner of a vehicle drives it and computes its observations."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.engine.simulation import Simulation
from cavmarl.shards.executor import PhaseExecutor
from cavmarl.shards.phases import Phase
from cavmarl.shards.shard import Commands, Shard
from cavmarl.shards.shard_group import ShardGroup
from tests.support.driving import drive, make_simulation, start
from tests.support.world import use_executor

STEPS = 40
AGENTS = 12


def divided(kind: str) -> Simulation:
    settings = {"zones.count": 4, "zones.check_invariants": True, "action.kind": kind}
    simulation = make_simulation(
        "grid4x4", mode="respawn", agents=AGENTS, background=40, overrides=settings
    )
    start(simulation, seed=3)
    return simulation


class Strict(PhaseExecutor):
    """An executor that calls shards one by one, and checks their commands and outputs.

    Args:
        simulation: simulation whose phases are run.
        strangers: command that a zone gets for agents whose vehicles it does not own.
    """

    def __init__(self, simulation: Simulation, strangers: float) -> None:
        self.controlled = 0
        self.sensed: list[set[int]] = []
        self._hosts = [(shard, ShardGroup([shard])) for shard in simulation.shards]
        self._strangers = strangers

    def run(self, phase: Phase, arguments: tuple[Any, ...]) -> None:
        for shard, group in self._hosts:
            if phase in (Phase.BEGIN_STEP, Phase.ADVANCE):
                phase.run(group, (self._own(shard, *arguments),))
            elif phase is Phase.SENSE:
                self._sense(shard, group, *arguments)
            else:
                phase.run(group, arguments)

    def _own(self, shard: Shard, commands: Commands) -> Commands:
        others = ~np.isin(np.arange(commands.controls.shape[1]), agents_of(shard))
        controls, meta_actions = commands.controls.copy(), commands.meta_actions.copy()
        controls[:, others] = self._strangers
        meta_actions[:, others] = 4
        self.controlled += int(others.sum())
        return Commands(controls, meta_actions)

    def _sense(self, shard: Shard, group: ShardGroup, chosen: NDArray[np.bool_]) -> None:
        """Check that the shard writes only the outputs of its own agents."""
        owned, outputs = agents_of(shard), shard.outputs
        before = [array.copy() for array in outputs]
        group.sense(chosen)
        others = ~np.isin(np.arange(outputs.present.shape[1]), owned)
        for array, old in zip(outputs, before, strict=True):
            assert array[:, others].tobytes() == old[:, others].tobytes()
        self.sensed.append(set(owned.tolist()))


def agents_of(shard: Shard) -> NDArray[np.int64]:
    """Return the agents whose vehicles a zone owns."""
    agents: NDArray[np.int64] = shard.worlds.rows["agent"][0, : shard.worlds.num_owned[0]]
    return agents[agents >= 0]


@pytest.mark.parametrize(("kind", "strangers"), [("continuous", np.nan), ("discrete", 1e9)])
def test_only_the_owner_of_a_vehicle_uses_its_command(kind: str, strangers: float) -> None:
    plain, watched = divided(kind), divided(kind)
    strict = Strict(watched, strangers)
    use_executor(watched, strict)
    for _ in range(STEPS):
        for simulation in (plain, watched):
            drive(simulation)
        assert watched.state_hash() == plain.state_hash()
        assert watched.outputs.observations.tobytes() == plain.outputs.observations.tobytes()
        zones = strict.sensed[-4:]
        assert sum(map(len, zones)) == len(set.union(*zones))
    assert watched.migrations > 0
    assert strict.controlled > STEPS * AGENTS


def test_the_world_differs_if_the_owner_gets_no_command() -> None:
    plain, watched = divided("continuous"), divided("continuous")
    use_executor(watched, Strict(watched, 0.0))
    shard = watched.shards[0]
    agent = int(agents_of(shard)[0])
    for simulation in (plain, watched):
        shape = simulation.outputs.present.shape
        controls = np.zeros((*shape, 2))
        controls[0, agent, 0] = 2.0 if simulation is plain else 0.0
        simulation.step(Commands(controls, np.zeros(shape, dtype=np.int64)))
    assert watched.state_hash() != plain.state_hash()
