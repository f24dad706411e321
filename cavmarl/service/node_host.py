"""A node: registers with a service, hosts the worlds of sessions, and runs evaluations."""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from cavmarl.core.errors import CavmarlError, ServiceError, require
from cavmarl.core.scratch_folder import scratch_folder
from cavmarl.core.server_address import listen
from cavmarl.evaluate.evaluation import evaluate
from cavmarl.evaluate.subprocess_calls import call_in_fresh_process
from cavmarl.service.configuration_files import placed_policies
from cavmarl.service.configurations import world_of
from cavmarl.service.error_names import without_folders
from cavmarl.service.node_app import in_turn, make_node_app
from cavmarl.service.node_link import (
    MOST_MESSAGE,
    NodeLink,
    is_final,
    must_register,
    until_answered,
)
from cavmarl.service.node_training import run_files, train
from cavmarl.service.server import HttpServer, ServerOptions, check_transport, uvicorn_config
from cavmarl.service.session_worlds import SessionWorlds
from cavmarl.service.training_settings import CAPABILITY, RUN
from cavmarl.service.zone_processes import ZoneProcesses

TELL_S = 0.5  # time between two progress reports of a job
DRAIN_S = 60.0  # time after SIGTERM at which a node ends even if sessions are left


@dataclass(frozen=True)
class NodeOptions:
    """Where a node listens, and what it offers."""

    service: str  # URL of the service
    secret: str
    name: str
    host: str = "127.0.0.1"
    port: int = 0  # port for clients; 0 picks a free port
    simulator_port: int | None = None  # only reported to clients; cavmarl does not use it
    slots: int = 4
    capabilities: tuple[str, ...] = ()
    allowed: tuple[str, ...] = ()
    is_supposed_idle: bool = False  # report no load
    certificate: Path | None = None
    key: Path | None = None
    # certificate of the authority that signed the service's certificate
    authority: str | None = None
    allow_plain_http: bool = False  # send the secret to another machine even without TLS


@dataclass
class _Host:
    link: NodeLink
    worlds: SessionWorlds
    tell: Callable[[str], None]
    jobs: dict[str, asyncio.Task[None]] = field(default_factory=dict)
    # job whose outcome was reported → number of the first heartbeat after the report
    reported: dict[str, int] = field(default_factory=dict)
    steps: dict[str, tuple[int, int]] = field(default_factory=dict)  # steps of jobs: done, total
    paused: set[str] = field(default_factory=set)  # trainings that another node is to continue
    zones: ZoneProcesses = field(default_factory=ZoneProcesses)
    telling: asyncio.Task[None] | None = None
    failure: ServiceError | None = None
    is_ending: bool = False


def host_node(options: NodeOptions, tell: Callable[[str], None]) -> None:
    """Run a node until it is drained or interrupted; SIGTERM drains it.

    Raises:
        ServiceError: the service refuses the node, or an address that other machines reach has no
            TLS.
        MissingExtraError: the node is to train, and torch is not installed.
    """
    if CAPABILITY in options.capabilities:
        require("torch", "train")
    check_transport(options.host, options.certificate, options.key)
    with scratch_folder():  # files of sessions, recordings and jobs
        asyncio.run(_run(options, tell))


async def _run(options: NodeOptions, tell: Callable[[str], None]) -> None:
    listener = listen(options.host, options.port)
    port = listener.getsockname()[1]
    tls = ["tls"] if options.certificate else []
    body = {
        "name": options.name,
        "address": options.host,
        "client_port": port,
        "simulator_port": options.simulator_port or port,
        "slots": options.slots,
        "capabilities": [*tls, *options.capabilities],
        "allowed": list(options.allowed),
    }
    trust = {
        "verify": options.authority or True,
        "allow_plain_http": options.allow_plain_http,
    }
    link = NodeLink(options.service, options.secret, body, options.is_supposed_idle, **trust)
    host = _Host(link, SessionWorlds(options.slots), tell)
    server = HttpServer(
        uvicorn_config(
            make_node_app(link, host.worlds),
            ServerOptions(certificate=options.certificate, key=options.key),
        )
    )
    try:
        await link.register()
        tell(f"node {options.name}: {options.host}:{port}, incarnation {link.incarnation}")
        loop = asyncio.get_running_loop()
        with contextlib.suppress(NotImplementedError):
            loop.add_signal_handler(signal.SIGTERM, _end, host)
        serving = asyncio.create_task(server.serve([listener]))
        await _beat_until_end(host)
        server.should_exit = True
        await serving
    finally:
        for job in host.jobs.values():
            job.cancel()
        host.zones.end()
        await link.close()
        listener.close()
    if host.failure is not None:
        raise host.failure


def _end(host: _Host) -> None:
    host.is_ending = True


async def _beat_until_end(host: _Host) -> None:
    """Send heartbeats until the node is drained and empty, or the service rejects it."""
    link, loop = host.link, asyncio.get_running_loop()
    pause_s, drained_s, is_known = 0.2, float("inf"), True
    while True:
        try:
            if not is_known:
                await link.register()
                is_known = True
            if host.is_ending and not link.is_draining:
                await link.drain()
            number = link.beats
            told = await link.beat(host.worlds.counters(), host.steps, host.worlds.is_watched)
            host.worlds.tell_scores(told["scores"])
            pause_s = told["beat_s"]
            host.worlds.keep_only(link.own(told["sessions"]))
            _start_jobs(host, told["jobs"], number)
            host.zones.follow(told["zones_of"])
            if host.telling is None or host.telling.done():
                host.telling = asyncio.create_task(_tell_transfers(host))
            if link.is_draining:
                drained_s = min(drained_s, loop.time())
                is_empty = host.paused.issuperset(told["sessions"])
                if is_empty or (host.is_ending and loop.time() > drained_s + DRAIN_S):
                    await link.leave()
                    host.tell(f"node {link.name}: drained")
                    return
        except ServiceError as error:
            if must_register(error):
                is_known = False
            elif is_final(error):
                host.failure = error
                return
            elif host.is_ending:
                return
        await asyncio.sleep(pause_s)


def _start_jobs(host: _Host, jobs: list[dict[str, Any]], beat: int) -> None:
    """Run the jobs in the answer to a heartbeat, and end all others."""
    for job in jobs:
        # If an answer names a job after its outcome was reported, this node has to repeat the job.
        is_repeated = host.reported.get(job["id"], beat + 1) <= beat
        if job["id"] in host.paused and not host.link.is_draining:
            host.paused.discard(job["id"])
            is_repeated = True
        if job["id"] not in host.jobs or is_repeated:
            host.reported.pop(job["id"], None)
            host.jobs[job["id"]] = asyncio.create_task(_run_job(host, job))
    wanted = {job["id"] for job in jobs}
    for number in [one for one in host.jobs if one not in wanted]:
        host.jobs.pop(number).cancel()
        host.reported.pop(number, None)


async def _tell_transfers(host: _Host) -> None:
    """Report to the service which vehicles have changed zone since the last report."""
    for session in host.worlds.divided():
        with contextlib.suppress(ServiceError):  # the session or the service has ended
            world = host.worlds[session]
            rows = await in_turn(host.worlds, world.ownership)
            await host.link.tell_transfers(session, world.number, rows)


async def _run_job(host: _Host, job: dict[str, Any]) -> None:
    """Run an evaluation or a training in a new process, and upload its files to the service."""
    link, path = host.link, f"/jobs/{job['id']}"
    status, message = "done", ""
    started: list[subprocess.Popen[bytes]] = []
    with TemporaryDirectory() as folder, contextlib.ExitStack() as ended:
        try:
            document = await until_answered(lambda: link.configuration(job["configuration"]))
            files = await until_answered(lambda: link.fetch_files(document))
            if files is not None:
                ended.enter_context(files)
            what = f"job {job['id']}"

            def hear(done: int, total: int) -> None:
                host.steps[job["id"]] = done, total

            if "settings" in job:
                work = Path(folder if files is None else files.name)
                if not await train(link, job, document, work, hear):
                    host.paused.add(job["id"])
                    return
                place = work / RUN
            else:
                place = Path(folder) / "results"
                await asyncio.to_thread(
                    call_in_fresh_process, what, run_evaluation, document, job, place,
                    None if files is None else files.name, hear=hear, began=started.append,
                )  # fmt: skip
            for file in run_files(place):
                await _report(link, "PUT", f"{path}/results/{file.name}", content=file.read_bytes())
        except CavmarlError as error:
            status, message = "failed", without_folders(str(error))[:MOST_MESSAGE]
        except asyncio.CancelledError:  # the job is closed, or another node has it
            for process in started:
                process.kill()
            raise
        finally:
            host.steps.pop(job["id"], None)
    # The service refuses the report if it has it already, or if another node has the job.
    with contextlib.suppress(ServiceError):
        outcome = {"status": status, "message": message}
        await _report(link, "POST", f"{path}/outcome", json=outcome)
    host.reported[job["id"]] = link.beats


async def _report(link: NodeLink, method: str, path: str, **given: Any) -> None:
    """Send a result or an outcome until the service has it; a second one changes nothing."""
    await until_answered(lambda: link.ask(method, path, **given))


def run_evaluation(
    document: dict[str, Any],
    job: dict[str, Any],
    folder: Path,
    files: str | None,
    tell: Callable[[int, int], None],
) -> None:
    """Run a job in a separate process.

    Args:
        document: the configuration.
        job: the job.
        folder: where to write the results.
        files: folder with the files of the configuration, which becomes the working directory, so
            that the results name no folder of the node; None: there are no files.
        tell: called twice a second with the steps done and the total.
    """
    if files is not None:
        os.chdir(files)
    parts = job["repeats"] * len(job["policies"])
    ended, last, told_s = 0, ("", 0), -math.inf

    def progress(policy: str, steps: int, most: int) -> None:
        nonlocal ended, last, told_s
        if last[0] and (policy != last[0] or steps < last[1]):
            ended += 1
        last = policy, steps
        if time.monotonic() - told_s >= TELL_S:
            told_s = time.monotonic()
            tell(ended * most + steps, parts * most)

    environment, keys = world_of(document, ".")
    evaluate(
        environment,
        placed_policies(job["policies"], document.get("files", {}), "."),
        episodes=job["episodes"],
        repeats=job["repeats"],
        out=folder,
        seed=document["seed"],
        progress=progress,
        **keys,
    )
