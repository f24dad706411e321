"""Time until a standby takes over from a killed service, and lost acknowledged requests."""

from __future__ import annotations

import subprocess
import sys
import time
from contextlib import suppress
from statistics import median
from typing import Annotated, Any

from sqlalchemy import create_engine, text

from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, numbers_of, silent
from cavmarl.cli.output import about
from cavmarl.client import Client
from cavmarl.core.errors import ConfigError, ServiceError
from cavmarl.service.access import Access
from cavmarl.service.event_log import EventLog
from cavmarl.service.event_store import EventStore
from cavmarl.service.server import first_admin

MOST_S = 60.0


def measure(
    server: Annotated[
        str, about("URL of a PostgreSQL server without a database, such as postgresql://u@host.")
    ] = "postgresql://postgres@127.0.0.1",
    events: Annotated[str, about("Events in the log, comma-separated.")] = "100,100000",
    repeats: Annotated[int, about("Takeovers for each length of the log.")] = 5,
    say: Say = silent,
) -> BenchmarkReport:
    """Kill a service that answers a client, and time the next acknowledged request."""
    check_range(repeats=(repeats, 1, 100))
    if not server.startswith("postgresql://"):
        raise ConfigError(f"--server {server}: must be postgresql://…")
    rows, lost = [], 0
    for count in numbers_of("--events", events):
        taken_s = []
        for turn in range(repeats):
            say(f"{count} events, takeover {turn + 1} of {repeats}")
            seconds, missing = _take_over(server, count)
            taken_s.append(seconds)
            lost += missing
        rows.append({"events": str(count), "median": median(taken_s), "most": max(taken_s)})
    return BenchmarkReport(
        "takeover by a standby",
        {"events": "events", "median, s": "median:.2f", "most, s": "most:.2f"},
        rows,
        facts={"lost": lost},
        holds=lost == 0,
        notes=[f"acknowledged and lost: {lost}"],
    )


def _take_over(server: str, events: int) -> tuple[float, int]:
    """Return the seconds without a service, and the number of lost identities."""
    name = f"takeover_{time.time_ns()}"
    engine = create_engine(server.replace("postgresql:", "postgresql+psycopg:") + "/postgres")
    with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as admin:
        admin.execute(text(f"CREATE DATABASE {name}"))
        try:
            return _kill_and_wait(f"{server}/{name}", events)
        finally:
            admin.execute(text(f"DROP DATABASE {name} WITH (FORCE)"))
            engine.dispose()


def _kill_and_wait(store: str, events: int) -> tuple[float, int]:
    secret = _filled(store, events)
    services: list[subprocess.Popen[str]] = []
    try:
        urls = [_started(services, store, *options) for options in ((), ("--standby",))]
        assert services[1].stdout is not None
        services[1].stdout.readline()  # the standby prints this line after it has read the log
        with Client(",".join(urls), secret) as client:
            known = [_add(client, k) for k in range(20)]
            services[0].kill()
            began_s = time.monotonic()
            while True:
                with suppress(ServiceError):
                    known.append(_add(client, len(known)))
                    break
                if time.monotonic() > began_s + MOST_S:
                    raise ServiceError(f"the standby did not take over within {MOST_S:g} s")
            taken_s = time.monotonic() - began_s
            there = {one["id"] for one in client.get("/identities")["identities"]}
        return taken_s, len(set(known) - there)
    finally:
        for process in services:
            process.kill()
            process.communicate()


def _filled(store: str, events: int) -> str:
    """Write events to a new store; return the secret of the admin."""
    log = EventLog(EventStore(store))
    try:
        secret = first_admin(log, Access(log))
        for _ in range(events - log.sequence):
            log.record("clock.anomaly", "service", {"jump_s": 1.0})
        log.flush()
    finally:
        log.store.close()
    assert secret is not None
    return secret


def _started(services: list[subprocess.Popen[str]], store: str, *options: str) -> str:
    words = [sys.executable, "-m", "cavmarl", "serve", "--port", "0", "--store", store, *options]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    services.append(process)
    assert process.stdout is not None
    return process.stdout.readline().split()[1].rstrip(",")


def _add(client: Client, number: int) -> Any:
    return client.post("/identities", {"name": f"guest-{number}", "role": "viewer"})["identity"]


if __name__ == "__main__":
    run(measure)
