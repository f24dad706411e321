"""Training jobs on a Ray cluster: the program of each job trains in a task of Ray.

Ray starts the task again on another machine if its machine fails, and the run continues from its
last checkpoint.
"""

from __future__ import annotations

import json
import shlex
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cavmarl.core.errors import TrainingError, require
from cavmarl.learning.cluster_job import TrainingJob

MAX_LOSSES = 20  # losses of machines or processes before Ray abandons the task


def submit(job: TrainingJob, cpus: int, gpus: int) -> str:
    """Queue a job, and return its number in Ray.

    Raises:
        MissingExtraError: Ray, or its part for jobs, is not installed.
        TrainingError: there is no cluster, or it refuses the job.
    """
    require("aiohttp_cors", "cluster")  # needed by Ray's part for jobs
    jobs = require("ray.job_submission", "cluster")
    words = [sys.executable, "-m", __name__, json.dumps(asdict(job)), str(cpus), str(gpus)]
    try:
        client = jobs.JobSubmissionClient()
        return str(client.submit_job(entrypoint=shlex.join(words)))
    except (ConnectionError, RuntimeError) as error:
        raise TrainingError(
            f"--to ray: no job can be queued: {error}. Start a cluster (ray start --head), or set "
            "RAY_API_SERVER_ADDRESS to the address of its dashboard, for example "
            "http://127.0.0.1:8265"
        ) from error


def train(job: TrainingJob, cpus: int, gpus: int) -> str:
    """Train in a task of the cluster of this program, and return the folder of the run.

    Raises:
        TrainingError: the program of the job has failed, or its machines were lost too often.
    """
    ray = require("ray", "ray")

    def run() -> str:
        return job()

    ray.init()
    needs: dict[str, Any] = {"num_cpus": cpus, "num_gpus": gpus, "max_retries": MAX_LOSSES}
    task = ray.remote(run).options(name=Path(job.folder).name, **needs)
    try:
        return str(ray.get(task.remote()))
    except ray.exceptions.RayTaskError as error:
        raise TrainingError(str(error.cause)) from error
    except ray.exceptions.RayError as error:
        raise TrainingError(f"{job.folder}: Ray ended the job: {error}") from error


if __name__ == "__main__":
    print(train(TrainingJob(**json.loads(sys.argv[1])), int(sys.argv[2]), int(sys.argv[3])))
