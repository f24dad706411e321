"""Worlds over the ranks of an MPI run have equal results; a lost rank ends the run."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

MPIRUN = Path(sys.executable).with_name("mpirun")
NODE = [sys.executable, "-m", "cavmarl", "node", "--mpi"]
RUN_S = 60.0

pytestmark = [
    pytest.mark.skipif(
        find_spec("mpi4py") is None or not MPIRUN.is_file(),
        reason="mpi4py or mpich is not installed: pip install '.[mpi]'",
    ),
]

PROGRAM = """
import os, signal, sys
from cavmarl import make_vec
from cavmarl.core.errors import WorkerDeathError
from tests.support.vec_runs import drive, same

wanted = {"agents": 6, "background": 20, "max_cycles": 8}
if "lost" in sys.argv:
    wanted["overrides"] = {"workers.timeout_s": 1.0}
vec = make_vec("grid4x4", zones=4, backend="nodes:2@mpi", **wanted)
pid = vec.worlds.pool.pids[1]

def lose(step):
    if step == 5 and "lost" in sys.argv:
        os.kill(pid, signal.SIGSTOP)
    if step == 5 and "killed" in sys.argv:
        os.kill(pid, signal.SIGKILL)

try:
    found = drive(vec, before=lose)
except WorkerDeathError as error:
    print("typed:", error, flush=True)
    raise
whole = make_vec("grid4x4", zones=1, **wanted)
print("equal:", same(found, drive(whole)), flush=True)
"""


def mpirun(*words: str) -> subprocess.CompletedProcess[str]:
    """Run a program with MPI and return its output; check that no shared memory remains."""
    before = set(Path("/dev/shm").glob("mpich*"))
    done = subprocess.run(
        [str(MPIRUN), *words],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=RUN_S,
    )
    assert set(Path("/dev/shm").glob("mpich*")) <= before
    return done


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).resolve().parents[2]))
    path = tmp_path / "program.py"
    path.write_text(PROGRAM)
    return str(path)


def test_separate_mpi_ranks_are_the_nodes_of_a_program(program: str) -> None:
    done = mpirun("-n", "1", sys.executable, program, ":", "-n", "2", *NODE)
    assert done.returncode == 0, done.stdout
    assert "equal: True" in done.stdout
    assert done.stdout.count("the caller has ended") == 2


def test_rank_0_runs_the_program_and_other_ranks_are_nodes(program: str) -> None:
    done = mpirun("-n", "3", *NODE, program)
    assert done.returncode == 0, done.stdout
    assert "equal: True" in done.stdout


@pytest.mark.parametrize("loss", ["lost", "killed"])
def test_a_lost_rank_ends_the_run(program: str, loss: str) -> None:
    """A typed error or MPI itself ends the run, so that no process waits forever."""
    done = mpirun("-n", "3", *NODE, program, loss)
    assert done.returncode != 0, done.stdout
    assert "equal" not in done.stdout
    if loss == "lost":
        assert "rank 2 of MPI, which has no failover" in done.stdout


def test_a_run_without_a_caller_ends() -> None:
    done = mpirun("-n", "2", *NODE)
    assert done.returncode != 0
    assert "rank 0 is the caller: name its program" in done.stdout


def test_more_nodes_than_ranks_are_refused(program: str) -> None:
    """Rank 0 ends before it listens, and the other ranks end, too."""
    done = mpirun("-n", "2", *NODE, program)
    assert done.returncode != 0
    assert "there are 1 other ranks" in done.stdout
    assert "rank 0 of MPI has ended" in done.stdout
