"""Training as a job of a Ray cluster."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("torch", reason="needs the extra: train")
pytest.importorskip("ray", reason="needs the extra: ray")

from cavmarl.cli.submit_train import make_job
from cavmarl.core.errors import MissingExtraError, TrainingError
from cavmarl.evaluate.provenance.training_record import CHECKPOINT_FILE, is_trained
from tests.learning.test_cluster_job import RUN, check_resumed, here, refusal, submit, wait

__all__ = ["here"]

pytestmark = pytest.mark.filterwarnings("ignore")  # Ray warns about its own code


@pytest.fixture
def cluster(here: Path) -> Iterator[Any]:
    """Yield a cluster whose head has no CPU, so tasks run only on added nodes."""
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    yield made
    made.shutdown()


def test_a_job_resumes_on_another_machine_after_a_loss(here: Path, cluster: Any) -> None:
    first = cluster.add_node(num_cpus=1)
    shorter = ["--total-agent-steps", "12000", "--checkpoint-updates", "20"]
    told = json.dumps(asdict(make_job("ppo", [*RUN[1:], *shorter, "--name", "job"], 1)))
    with Path("log").open("w") as log:
        program = subprocess.Popen(
            [sys.executable, "-m", "cavmarl.learning.ray_job", told, "1", "0"],
            env=os.environ | {"RAY_ADDRESS": cluster.address},
            stdout=log,
            stderr=log,
        )
    folder = here / "runs/job"
    try:
        wait((folder / CHECKPOINT_FILE).exists, Path("log"))
        cluster.remove_node(first, allow_graceful=False)
        assert not is_trained(folder)
        cluster.add_node(num_cpus=1)
        assert program.wait(300) == 0, Path("log").read_text()
    finally:
        program.kill()
        program.wait()
    assert is_trained(folder)
    check_resumed(folder, *shorter)


@pytest.mark.slow
def test_a_job_fails_if_its_program_fails(here: Path, cluster: Any) -> None:
    cluster.add_node(num_cpus=1)
    job = make_job("ppo", [*RUN[1:], "--name", "job"], 1)
    (here / "runs").mkdir()
    (here / "runs/job").touch()
    done = subprocess.run(
        [sys.executable, "-m", "cavmarl.learning.ray_job", json.dumps(asdict(job)), "1", "0"],
        env=os.environ | {"RAY_ADDRESS": cluster.address},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert "runs/job: the program ended with exit code 2" in done.stderr.splitlines()[-1]


def test_the_error_without_the_job_server_of_ray_names_the_extra(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "aiohttp_cors", None)
    assert "[cluster]" in refusal(MissingExtraError, *RUN, "--to", "ray")


def test_an_unreachable_cluster_is_an_error(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("aiohttp_cors", reason="needs the extra: cluster")
    monkeypatch.setenv("RAY_API_SERVER_ADDRESS", "http://127.0.0.1:9")
    assert "--to ray: no job can be queued" in refusal(TrainingError, *RUN, "--to", "ray")


def test_a_job_of_ray_trains(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("aiohttp_cors", reason="needs the extra: cluster")
    ray = [sys.executable, "-m", "ray.scripts.scripts"]
    jobs = pytest.importorskip("ray.job_submission")
    subprocess.run([*ray, "start", "--head", "--num-cpus=1", "--port=0"], check=True)
    try:
        told = submit(*RUN, "--to", "ray", "--name", "job", "--total-agent-steps", "2000")
        client = jobs.JobSubmissionClient()
        wait(lambda: client.get_job_status(told["job"]).is_terminal(), within_s=600)
        assert client.get_job_status(told["job"]) == jobs.JobStatus.SUCCEEDED
        assert told["run"] in client.get_job_logs(told["job"])
    finally:
        subprocess.run([*ray, "stop", "--force"], check=True)
    assert told["log"] == f"ray job logs {told['job']}"
    check_resumed(Path(told["run"]), "--total-agent-steps", "2000")
