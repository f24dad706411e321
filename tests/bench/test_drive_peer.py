"""The peer in C observes what our sensor observes."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from cavmarl.bench import drive_peer
from cavmarl.bench.drive_peer import OBSERVATION, PUFFER_DRIVE, DrivePeer, compile_peer
from cavmarl.bench.highway_worlds import straight_road
from cavmarl.bench.peer_speed import FLAGS, drive_world
from cavmarl.bench.step_speed import measure_step_speed
from cavmarl.core.errors import ConfigError, EvaluationError
from cavmarl.env.vector import make_vec

needs_compiler = pytest.mark.skipif(
    shutil.which(os.environ.get("CC", "cc")) is None, reason="no C compiler"
)
CLOSE = 2e-5  # float32 at some kilometres from the corner, in units of 50 m


@needs_compiler
@pytest.mark.parametrize("flags", FLAGS.values())
def test_the_peer_sees_the_same_on_the_bench_road(flags: tuple[str, ...], tmp_path: Path) -> None:
    vec = drive_world(straight_road(tmp_path, 200.0), 12, 2, copy=False)
    ours, _ = vec.reset(seed=0)
    peer = DrivePeer(compile_peer(tmp_path, flags), vec)
    peer.reset()
    assert ours.shape == (2, 12, OBSERVATION)
    assert np.count_nonzero(ours[..., 6 : 6 + 63 * 7]), "somebody sees a partner"
    np.testing.assert_allclose(peer.observations, ours.reshape(-1, OBSERVATION), atol=CLOSE)
    for _ in range(3):
        ours, _, ended, _, _ = vec.step(np.zeros((2, 12, 2), np.float32))
        assert not ended.any()
        peer.step()
        np.testing.assert_allclose(peer.observations, ours.reshape(-1, OBSERVATION), atol=CLOSE)
    peer.close()


@needs_compiler
@pytest.mark.parametrize("env", ["merge", "grid4x4"])
def test_the_peer_sees_the_same_among_junctions(env: str, tmp_path: Path) -> None:
    vec = make_vec(
        env, agents=8, background=0, overrides={**PUFFER_DRIVE, "population.mode": "closed"}
    )
    ours, _ = vec.reset(seed=1)
    peer = DrivePeer(compile_peer(tmp_path, ("-O2",)), vec)
    peer.reset()
    np.testing.assert_allclose(peer.observations, ours.reshape(-1, OBSERVATION), atol=CLOSE)
    peer.close()


@needs_compiler
def test_the_rows_of_the_peer_are_measured() -> None:
    pytest.importorskip("highway_env")
    found = measure_step_speed(agents=3, worlds=2, repeats=1, peer=True)
    rows = {row.who: row for row in found.rows if row.sensors == "puffer_drive"}
    assert sorted(rows) == ["batched", "c", "c_native", "copied"]
    assert found.ratio_peer == rows["batched"].median / rows["c"].median
    assert found.ratio_peer_native == rows["batched"].median / rows["c_native"].median


def test_without_a_compiler_it_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(EvaluationError, match="no C compiler 'no-such-compiler': install one"):
        drive_peer.check_compiler()


@needs_compiler
def test_what_the_compiler_says_is_passed_on(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match="no-such-flag"):
        compile_peer(tmp_path, ("--no-such-flag",))


def test_the_sensor_refuses_what_it_cannot_be() -> None:
    with pytest.raises(ConfigError, match=r"puffer_drive\.partners = 257: must be from 0 to 256"):
        make_vec("ring", overrides={"sensors.puffer_drive.partners": 257})
