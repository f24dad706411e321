"""A zone gets ghosts of the distant vehicles that its drivers may look at, and of no others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cavmarl.evaluate.built_in_runs import DrivenWorld, world_maker
from cavmarl.zones.kernels.zone_lookup import Halo
from cavmarl.zones.partition.zone_partition import ZonePartition
from cavmarl.zones.visibility import Visibility
from tests.support.netgenerate import netgenerate

STEPS = 40


@pytest.fixture(scope="module")
def blocks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make streets with fast traffic and no signals: drivers yield to distant vehicles."""
    return netgenerate(
        tmp_path_factory.mktemp("blocks") / "blocks.net.xml",
        "--grid", "--grid.number", "4", "--grid.length", "200", "-L", "2",
        "--default-junction-type", "priority", "--default.speed", "33",
    )  # fmt: skip


def driven(path: Path, **overrides: object) -> DrivenWorld:
    """Make a world without agents, in nine zones."""
    make = world_maker(
        str(path),
        (),
        layout="bisection",
        seconds=100,
        seed=0,
        agents=0,
        background=60,
        overrides=overrides,
    )
    world = DrivenWorld(make(9))
    for _ in range(STEPS):
        world.step(world.commands())
    return world


def ghosts(world: DrivenWorld) -> int:
    return int(world.simulation.zones.loads().ghosts.sum())


def test_a_configured_halo_adds_ghosts_and_changes_no_result(blocks: Path) -> None:
    """With ghosts from the whole halo, the world has more ghosts and the same state."""
    narrow = driven(blocks)
    whole = driven(blocks, **{"zones.halo_m": narrow.simulation.zones.loads().halo_m})
    assert ghosts(narrow) < 0.9 * ghosts(whole)
    assert narrow.simulation.state_hash() == whole.simulation.state_hash()


def test_the_distance_seen_at_a_stop_line_is_half_a_body_plus_the_clearance(
    blocks: Path,
) -> None:
    simulation = driven(blocks).simulation
    kept_m = float(simulation.network.lanes["stop_back_m"].max())
    half_m = 0.5 * float(simulation.division.owned(0, 0)["length"].max())
    assert half_m + kept_m < simulation.division.halo.line_m < half_m + kept_m + 5.0


def test_the_monitor_accepts_the_ghosts_of_seen_vehicles(blocks: Path) -> None:
    """The invariant monitor reports no missing and no unneeded ghost."""
    assert ghosts(driven(blocks, **{"zones.check_invariants": True})) > 0


@pytest.mark.parametrize("fields", [("head",), ("line", "merge")])
def test_seeing_less_of_a_lane_changes_results(
    blocks: Path, fields: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without ghosts of leaders or of vehicles with the right of way, the world differs."""
    seen = Visibility.halo

    def blind(sight: Visibility, partition: ZonePartition) -> Halo:
        halo = seen(sight, partition)
        for field in fields if partition.count > 1 else ():
            halo.watchers[field] = -np.inf if field == "head" else np.inf
        return halo

    whole = driven(blocks).simulation.state_hash()
    monkeypatch.setattr(Visibility, "halo", blind)
    assert driven(blocks).simulation.state_hash() != whole
