"""`cavmarl submit train`: runs a training program as a job of a cluster."""

from __future__ import annotations

import ast
import importlib.util
import sys
from dataclasses import fields
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cavmarl.cli.output import about, parse_settings
from cavmarl.cli.service import (
    DEFAULT_URL,
    Authority,
    PlainHttp,
    Url,
    UserSecretFile,
    connect,
    uploads,
)
from cavmarl.cli.train import extras_of, with_config
from cavmarl.config.registry import find_entry, programs
from cavmarl.core.errors import ConfigError, TrainingError, require, require_all

if TYPE_CHECKING:
    from cavmarl.client import Client
    from cavmarl.learning.cluster_job import TrainingJob

PLACES = ("slurm", "ray", "service", "local")
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
        about(
            "Where the job runs: slurm, ray, service (a node of a coordination service), or local "
            "(this machine).",
            metavar="PLACE",
        ),
    ] = "slurm",
    processes: Annotated[
        int, about("Processes that train one network together; only for ppo.", metavar="N", min=1)
    ] = 1,
    cpus: Annotated[int, about("CPUs of each process.", metavar="N", min=1, panel=CLUSTER)] = 1,
    gpus: Annotated[int, about("GPUs of the job.", metavar="N", min=0, panel=CLUSTER)] = 0,
    job_minutes: Annotated[
        int | None,
        about(
            "Minutes after which a job is stopped and queued again, with slurm and local [default: "
            "a day].",
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
    service: Url = DEFAULT_URL,
    secret_file: UserSecretFile = None,
    authority: Authority = None,
    plain_http: PlainHttp = False,
) -> None:
    """Train a driver as a job of a cluster, which resumes after it was preempted.

    The job is checked before it is queued. With slurm and ray, all machines need this installation
    and the folder of the run. With service, the files of the environment and of drivers are
    uploaded, and `cavmarl sessions --collect JOB` fetches the driver.
    """
    if to not in PLACES:
        known = f"{', '.join(PLACES[:-1])} or {PLACES[-1]}"
        raise ConfigError(f"--to {to}: unknown; give {known}")
    for option, is_given, places in (
        ("--sbatch", sbatch, ("slurm",)),
        ("--job-minutes", job_minutes, ("slurm", "local")),
        ("--processes", processes > 1, ("slurm", "ray", "local")),
        ("--cpus", cpus > 1, ("slurm", "ray", "local")),
        ("--gpus", gpus, ("slurm", "ray", "local")),
    ):
        if is_given and to not in places:
            raise ConfigError(f"{option}: has no effect with --to {to}; leave it out")
    words = with_config(options or [])
    if to == "service":
        args = _arguments(name, words)[1]
        with connect(service, secret_file, authority, plain_http) as client:
            number = _submit_to_service(client, args)
        collect = f"cavmarl sessions --collect {number} --out {args.folder}"
        typer.echo(f"job: {number}\nrun: {args.folder}\ncollect: {collect}")
        return
    parameters = _pairs(sbatch or [])
    job = make_job(name, words, processes)
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
    if processes > 1 and name != "ppo":
        raise ConfigError(f"--processes {processes}: {name} trains in one process; use ppo")
    program, args = _arguments(name, words)
    from cavmarl.learning.cluster_job import TrainingJob
    from cavmarl.learning.data_parallel import Ranks

    if processes > 1:
        Ranks(processes).share("--num-envs", args.num_envs)
    folder = args.folder.resolve()
    return TrainingJob(str(program), words, str(folder), str(Path.cwd()), processes)


def _arguments(name: str, words: list[str]) -> tuple[Path, Any]:
    """Return the path and the checked settings of a program; the errors are those of `make_job`."""
    known = {each: path for each, path in programs().items() if _can_resume(path)}
    if name not in known:
        raise ConfigError(
            f"{name}: is no training program that can resume; choose one of {', '.join(known)}"
        )
    require_all(extras_of(known[name]))
    from cavmarl.learning.run_folder import parse_run, refuse_begun

    args = parse_run(_loaded(known[name]).Args, words, "")
    find_entry(args.env)
    if not args.resume:
        refuse_begun(args.folder.resolve(), can_resume=True)
    return known[name], args


def _submit_to_service(client: Client, args: Any) -> str:
    """Submit a training with these settings to a service, and return the id of the job.

    Raises:
        ConfigError: a setting does not exist there.
        ServiceError: the service refuses the job.
    """
    from cavmarl.learning.options import split_settings
    from cavmarl.service.training_settings import DRIVERS, OF_CONFIGURATION, OF_NODE, PROGRAM

    if args.program != f"{PROGRAM}.py":
        raise ConfigError(f"--to service: nodes of a service train with {PROGRAM} only; use it")
    chosen = {one.name: getattr(args, one.name) for one in fields(args)}
    changed = {one.name for one in fields(args) if chosen[one.name] != one.default}
    for key in sorted(OF_NODE & changed - {"runs", "name"}):
        option = "import" if key == "plugins" else key
        raise ConfigError(f"--{option}: has no effect with --to service; leave it out")
    settings = {key: chosen[key] for key in changed - OF_CONFIGURATION - OF_NODE}
    settings["total_agent_steps"] = args.total_agent_steps  # progress is shown up to it
    keys: dict[str, Any] = {"num_envs": args.num_envs, "seed": args.seed}
    keys["overrides"] = parse_settings(split_settings(args.settings))
    keys |= {key: chosen[key] for key in ("agents", "zones") if chosen[key]}
    if args.background >= 0:
        keys["background"] = args.background
    used = [word for key in DRIVERS for word in chosen[key].split(",") if word]
    environment, names, keys["drivers"] = uploads(args.env, used)
    placed = dict(zip(used, names, strict=True))
    settings |= {
        key: ",".join(placed[word] for word in chosen[key].split(",") if word)
        for key in DRIVERS
        if chosen[key]
    }
    return client.train(environment, settings=settings, **keys)


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
