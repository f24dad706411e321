"""Compare worlds over nodes with undivided worlds (`cavmarl verify nodes`)."""

from __future__ import annotations

import pytest

from cavmarl import ConfigError
from cavmarl.env.vector import CavVectorEnv
from cavmarl.verify.node_losses import verify_nodes
from tests.cli.test_main import run


def test_worlds_over_nodes_equal_the_undivided_one_while_nodes_are_killed() -> None:
    found = verify_nodes("grid4x4", nodes=(1, 3), kills=2, steps=30, agents=4, background=30)
    assert found.holds
    assert [run.nodes for run in found.runs] == [1, 3]
    assert [run.killed for run in found.runs] == [0, 2]
    assert found.zones == 6
    assert found.to_dict()["holds"] is True


def test_a_difference_is_reported_with_its_step(monkeypatch: pytest.MonkeyPatch) -> None:
    hashed = CavVectorEnv.state_hash

    def wrong(vec: CavVectorEnv, world: int = 0) -> str:
        found = hashed(vec, world)
        return found if type(vec.worlds).__name__ == "LocalWorlds" else found[::-1]

    monkeypatch.setattr(CavVectorEnv, "state_hash", wrong)
    (run,) = verify_nodes("grid4x4", nodes=(2,), steps=8, agents=1, background=0).runs
    assert run.different == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"nodes": ()}, "must be one or more"),
        ({"nodes": (0,)}, "from 1 on"),
        ({"nodes": (2,), "kills": 30, "steps": 20}, "must be from 0 to 15"),
        ({"nodes": (3,), "zones": 2}, "needs 1 to 2 nodes"),
    ],
)
def test_bad_input_is_refused(arguments: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        verify_nodes("grid4x4", **arguments)  # type: ignore[arg-type]


def test_the_command_prints_and_writes_its_result(capsys: pytest.CaptureFixture[str]) -> None:
    words = ("--nodes", "2", "--steps", "5", "--zones", "2")  # the run is too short for kills
    assert run("verify", "nodes", "grid4x4", *words) == 0
    assert "equal" in capsys.readouterr().out
