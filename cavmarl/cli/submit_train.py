"""`cavmarl submit train`: runs a training program as a job of a cluster."""

from __future__ import annotations

import ast
import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated

import typer

from cavmarl.cli.output import about
from cavmarl.cli.train import extras_of, with_config
from cavmarl.config.registry import find_entry, programs
from cavmarl.core.errors import ConfigError, TrainingError, require, require_all

if TYPE_CHECKING:
    from cavmarl.learning.cluster_job import TrainingJob

PLACES = ("slurm", "ray", "local")
REFUSED = {"service": "the service evaluates drivers, but trains none"}
CLUSTER = "Cluster"
DAY_MIN = 24 * 60


def submit_train(
    name: Annotated[
        str, typer.Argument(metavar="PROGRAM", help="Name of a program; `cavmarl train` lists all.")
    ],
    options: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="OPTIONS",
            help="Options of the program; `cavmarl train NAME --help` shows them.",
        ),
    ] = None,
    to: Annotated[
        str,
        about("Where the job runs: slurm, ray, or local for this machine.", metavar="PLACE"),
    ] = "slurm",
    processes: Annotated[
        int, about("Processes that train one network together; only for ppo.", metavar="N", min=1)
    ] = 1,
    cpus: Annotated[int, about("CPUs of each process.", metavar="N", min=1, panel=CLUSTER)] = 1,
    gpus: Annotated[int, about("GPUs of the job.", metavar="N", min=0, panel=CLUSTER)] = 0,
    job_minutes: Annotated[
        int | None,
        about(
            "Minutes after which a job is stopped and queued again; not with ray [default: a day].",
            metavar="MIN",
            min=1,
            panel=CLUSTER,
        ),
    ] = None,
    sbatch: Annotated[
        list[str] | None,
        about(
            "Option of Slurm's sbatch, for example partition=gpu; repeat it for more.",
            metavar="KEY=VALUE",
            panel=CLUSTER,
        ),
    ] = None,
) -> None:
    """Train a driver as a job of a cluster, which resumes after it was preempted.

    The job is checked before it is queued. All its machines need this installation, and the folder
    of the run.
    """
    if to not in PLACES:
        why = REFUSED.get(to, "unknown")
        raise ConfigError(f"--to {to}: {why}; give {', '.join(PLACES[:-1])} or {PLACES[-1]}")
    if sbatch and to != "slurm":
        raise ConfigError(f"--sbatch: has no effect with --to {to}; leave it out")
    if job_minutes and to == "ray":
        raise ConfigError("--job-minutes: has no effect with --to ray; leave it out")
    parameters = _pairs(sbatch or [])
    job = make_job(name, with_config(options or []), processes)
    if to == "ray":
        from cavmarl.learning import ray_job

        number = ray_job.submit(job, cpus * processes, gpus)
        typer.echo(f"job: {number}\nrun: {job.folder}\nlog: ray job logs {number}")
        return
    submitit = require("submitit", "cluster")
    logs = Path(job.folder) / "jobs"
    try:
        executor = submitit.AutoExecutor(folder=logs, cluster=to)
    except RuntimeError as error:
        raise TrainingError(
            f"--to {to}: this machine has no sbatch ({error}); submit the job on a machine of a "
            "Slurm cluster, or give --to local"
        ) from error
    executor.update_parameters(
        name=Path(job.folder).name,
        timeout_min=job_minutes or DAY_MIN,
        cpus_per_task=cpus * processes,
        gpus_per_node=gpus,
        slurm_additional_parameters=parameters,
    )
    try:
        queued = executor.submit(job)
    except submitit.core.utils.FailedJobError as error:
        raise TrainingError(f"--to {to}: the job was refused: {error}") from error
    typer.echo(f"job: {queued.job_id}\nrun: {job.folder}\nlog: {queued.paths.stdout}")


def make_job(name: str, words: list[str], processes: int) -> TrainingJob:
    """Return the job of a program after a check of its options.

    Raises:
        ConfigError: the program does not exist, cannot resume or refuses its options.
        TrainingError: the folder contains a run.
    """
    known = {each: path for each, path in programs().items() if _can_resume(path)}
    if name not in known:
        raise ConfigError(
            f"{name}: is no training program that can resume; choose one of {', '.join(known)}"
        )
    if processes > 1 and name != "ppo":
        raise ConfigError(f"--processes {processes}: {name} trains in one process; use ppo")
    require_all(extras_of(known[name]))
    from cavmarl.learning.cluster_job import TrainingJob
    from cavmarl.learning.data_parallel import Ranks
    from cavmarl.learning.run_folder import parse_run, refuse_begun

    args = parse_run(_loaded(known[name]).Args, words, "")
    find_entry(args.env)
    if processes > 1:
        Ranks(processes).share("--num-envs", args.num_envs)
    folder = args.folder.resolve()
    if not args.resume:
        refuse_begun(folder, can_resume=True)
    return TrainingJob(str(known[name]), words, str(folder), str(Path.cwd()), processes)


def _pairs(words: list[str]) -> dict[str, str]:
    """Return options KEY=VALUE as a dict."""
    for word in words:
        if not word.partition("=")[0] or not word.partition("=")[2]:
            raise ConfigError(f"--sbatch {word}: must be KEY=VALUE, for example partition=gpu")
    return {key: value for key, _, value in (word.partition("=") for word in words)}


def _can_resume(program: Path) -> bool:
    """Return whether a program has a setting `resume`, without importing the program."""
    return any(
        isinstance(node, ast.AnnAssign) and ast.unparse(node.target) == "resume"
        for node in ast.walk(ast.parse(program.read_text(encoding="utf-8")))
    )


def _loaded(program: Path) -> ModuleType:
    """Return a program as a module."""
    spec = importlib.util.spec_from_file_location(f"cavmarl_train_{program.stem}", program)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look up their module
    spec.loader.exec_module(module)
    return module
