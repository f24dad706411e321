"""Cost of the service: selection among many nodes, heartbeats, and a day of churn."""

from __future__ import annotations

import asyncio
import json
import secrets
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any
from urllib.parse import urlsplit

import httpx
import numpy as np
import psutil

from benchmarks.program import run
from cavmarl.bench.harness import BenchmarkReport, Say, check_range, silent
from cavmarl.cli.output import Seed, about
from cavmarl.client import Client
from cavmarl.core.errors import ServiceError
from cavmarl.service.access import Access
from cavmarl.service.broker import Broker, BrokerRules
from cavmarl.service.event_log import EventLog
from cavmarl.service.event_store import EventStore
from cavmarl.service.request_bodies import BeatBody, NodeBody
from cavmarl.service.service_records import Infrastructure
from cavmarl.service.snapshots import SNAPSHOT_EVENTS

CONFIGURATION = "0" * 64  # hash of a configuration that need not exist
NODES_AN_IDENTITY = 100  # the rate limit is per identity
SESSION_S, NODE_S = 600.0, 7200.0  # mean time until a session ends; until a node fails
FLUSHED_EVERY = 20  # simulated seconds between flushes of the log


def measure(
    nodes: Annotated[int, about("Nodes.")] = 1000,
    requests: Annotated[int, about("Number of timed selections.")] = 10_000,
    seconds: Annotated[int, about("Seconds of heartbeats at 1 Hz.")] = 20,
    hours: Annotated[float, about("Simulated hours of churn, with a tenth of the nodes.")] = 24.0,
    p95_ms: Annotated[
        float, about("Exit with 1 if the 95th percentile of a selection is above this.")
    ] = 10.0,
    seed: Seed = 0,
    say: Say = silent,
) -> BenchmarkReport:
    """Time selections and heartbeats, and replay a day in which nodes and sessions come and go."""
    check_range(
        nodes=(nodes, 1, 10_000), requests=(requests, 1, 1_000_000),
        seconds=(seconds, 1, 3600), hours=(hours, 0.01, 1000.0), p95_ms=(p95_ms, 0.0, 1e6),
    )  # fmt: skip
    rng = np.random.default_rng(seed)
    with TemporaryDirectory() as room:
        say(f"{requests} selections among {nodes} nodes")
        timed = _selections(Path(room) / "selection.sqlite", nodes, requests, rng)
        say(f"{seconds} s of heartbeats")
        share, beats_hz = _beats(Path(room) / "beats.sqlite", nodes, seconds)
        say(f"{hours:g} h of churn")
        churn = _churn(Path(room) / "churn.sqlite", max(nodes // 10, 3), hours, rng)
    rows = [
        {"what": f"selection among {nodes} nodes, {name}, ms", "value": value}
        for name, value in timed.items()
    ]
    rows.append({"what": f"{beats_hz:.0f} heartbeats/s, share of one core", "value": share})
    rows += [{"what": f"churn: {name}", "value": value} for name, value in churn.items()]
    return BenchmarkReport(
        "the coordination service",
        {"": "what", "found": "value:.3f"},
        rows,
        facts={
            "nodes": nodes,
            "selection_ms": timed,
            "p95_ms": p95_ms,
            "beats_share": share,
            "churn": churn,
        },
        holds=bool(churn["replay equal"]) and timed["p95"] <= p95_ms,
        notes=[f"bound: p95 of a selection at most {p95_ms:g} ms"],
    )


class _Fleet:
    """A broker and its clients, with a simulated clock."""

    def __init__(self, store: Path, rng: np.random.Generator) -> None:
        self.now_s, self.beats, self.rng = 0.0, 0, rng
        self.log = EventLog(EventStore(store), lambda: self.now_s)
        access = Access(self.log, lambda: self.now_s)
        self.broker = Broker(self.log, BrokerRules(), lambda: self.now_s)
        self.nodes = access.add_identity("nodes", "node")[0]
        self.client = access.add_identity("client", "client")[0]

    def register(self, name: str) -> None:
        body = NodeBody(name=name, address="127.0.0.1", client_port=1, simulator_port=1, slots=64)
        self.broker.register(self.nodes, body)

    def beat(self, name: str, load: Sequence[float]) -> None:
        self.beats += 1
        self.broker.beat(
            self.nodes,
            name,
            BeatBody(
                incarnation=self.log.state.nodes[name].incarnation, sequence=self.beats,
                cpu=load[0], ram=load[1], gpu=load[2], sent_s=self.now_s,
            ),
        )  # fmt: skip


def _selections(
    store: Path, nodes: int, requests: int, rng: np.random.Generator
) -> dict[str, float]:
    """Return percentiles of an assignment's processor time in ms."""
    fleet = _Fleet(store, rng)
    for k in range(nodes):
        fleet.register(f"node-{k}")
    spent: list[float] = []
    opened: list[str] = []
    for k in range(requests):
        if k % 100 == 0:
            for name in fleet.log.state.nodes:
                fleet.beat(name, rng.uniform(0.0, 0.8, 3).tolist())
            for number in opened:
                fleet.broker.close(fleet.client, number)
            opened.clear()
            fleet.log.flush()
        began = time.thread_time_ns()  # processor time
        opened.append(fleet.broker.open(fleet.client, CONFIGURATION).id)
        spent.append(1e-6 * (time.thread_time_ns() - began))
        if k % 1000 == 999:
            fleet.now_s += 4000.0  # expire finished sessions
            fleet.broker.sweep()
    fleet.log.store.close()
    return {f"p{quantile}": float(np.percentile(spent, quantile)) for quantile in (50, 95, 99)}


def _beats(store: Path, nodes: int, seconds: int) -> tuple[float, float]:
    """Return the processor time of a service per second of heartbeats, and the achieved rate."""
    words = [sys.executable, "-m", "cavmarl", "serve", "--port", "0", "--store", str(store)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            url = process.stdout.readline().split()[1].rstrip(",")
            secret = process.stdout.readline().split()[-1]
            granted = []
            with Client(url, secret) as admin:
                for k in range(-(-nodes // NODES_AN_IDENTITY)):
                    body = {"name": f"nodes-{k}", "role": "node"}
                    granted.append(admin.post("/identities", body)["secret"])
            return asyncio.run(_beat(url, granted, nodes, seconds, psutil.Process(process.pid)))
        finally:
            process.terminate()


async def _beat(
    url: str, granted: list[str], nodes: int, seconds: int, process: psutil.Process
) -> tuple[float, float]:
    """Send heartbeats; each connection has the nodes of one identity. Return what `_beats` does."""
    tokens = []
    async with httpx.AsyncClient(base_url=f"{url}/v1") as http:
        for secret in granted:
            grant = (await http.post("/token", json={"secret": secret})).json()
            tokens.append(grant["access_token"])
    place = urlsplit(url)
    lines = [await asyncio.open_connection(place.hostname, place.port) for _ in granted]
    owned = [range(k, nodes, len(granted)) for k in range(len(granted))]

    async def post(k: int, path: str, body: dict[str, Any]) -> None:
        reader, writer = lines[k]
        content = json.dumps(body).encode()
        head = (
            f"POST /v1{path} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {tokens[k]}\r\n"
            f"Content-Type: application/json\r\nContent-Length: {len(content)}\r\n\r\n"
        )
        writer.write(head.encode() + content)
        answer = (await reader.readuntil(b"\r\n\r\n")).lower()
        assert answer.startswith(b"http/1.1 20"), answer
        await reader.readexactly(int(answer.split(b"content-length:")[1].split(b"\r\n")[0]))

    async def register(k: int) -> None:
        for node in owned[k]:
            port = {"address": "127.0.0.1", "client_port": 1, "simulator_port": 1}
            await post(k, "/nodes", {"name": f"node-{node}", **port})

    async def beat(k: int, second: int) -> None:
        load = {"cpu": 0.2, "ram": 0.3, "gpu": 0.0}
        for node in owned[k]:
            content = {"incarnation": 1, "sequence": second, "sent_s": time.time(), **load}
            await post(k, f"/nodes/node-{node}/beat", content)

    await asyncio.gather(*map(register, range(len(granted))))
    began_s, before_s = time.monotonic(), sum(process.cpu_times()[:2])
    for second in range(seconds):
        await asyncio.gather(*(beat(k, second) for k in range(len(granted))))
        await asyncio.sleep(max(0.0, began_s + second + 1 - time.monotonic()))
    took_s = time.monotonic() - began_s
    used_s = sum(process.cpu_times()[:2]) - before_s
    for _, writer in lines:
        writer.close()
    return used_s / seconds, nodes * seconds / took_s  # s of processor time, heartbeats/s


def _churn(store: Path, nodes: int, hours: float, rng: np.random.Generator) -> dict[str, float]:
    """Let nodes fail, drain and return, and sessions begin and end; then replay the event log."""
    fleet = _Fleet(store, rng)
    names = [f"node-{k}" for k in range(nodes)]
    dead_until = dict.fromkeys(names, 0.0)
    opened: list[str] = []
    for name in names:
        fleet.register(name)
    refused = most = 0
    while fleet.now_s < hours * 3600.0:
        fleet.now_s += 1.0
        for name in names:
            if fleet.now_s < dead_until[name]:
                continue
            if rng.random() < 1.0 / NODE_S:  # the node fails, drains or restarts
                dead_until[name] = fleet.now_s + rng.exponential(60.0)
                if rng.random() < 0.5:
                    fleet.broker.drain(fleet.nodes, name, rng.random() < 0.5)
                elif rng.random() < 0.5:
                    fleet.register(name)
            elif int(fleet.now_s) % 2 == 0:
                fleet.beat(name, (0.3, 0.3, 0.0))
        try:
            opened.append(fleet.broker.open(fleet.client, CONFIGURATION).id)
            if rng.random() < 0.1:
                number = opened[rng.integers(len(opened))]
                session = fleet.broker.resolve(fleet.client, number)
                fleet.broker.save(session, session.saved_number + 1, secrets.token_bytes(64))
        except ServiceError:
            refused += 1
        for number in [one for one in opened if rng.random() < 1.0 / SESSION_S]:
            fleet.broker.close(fleet.client, number)
            opened.remove(number)
        fleet.broker.sweep()
        opened = [one for one in opened if fleet.log.state.sessions[one].state in
                  ("active", "queued")]  # fmt: skip
        most = max(most, len(fleet.log.state.sessions))
        if int(fleet.now_s) % FLUSHED_EVERY == 0:
            fleet.log.flush()
    fleet.log.end()
    events = fleet.log.sequence
    hosted = sum(len(live.hosted) for live in fleet.broker.live.values())
    active = sum(one.node is not None for one in fleet.log.state.sessions.values())
    state = fleet.log.state
    fleet.log.store.close()
    replay_s, replayed = _started(store, 0)
    start_s, started = _started(store, SNAPSHOT_EVENTS)
    return {
        "hours": hours,
        "events": events,
        "most sessions known at once": most,
        "requests refused": refused,
        "sessions hosted that are not active": hosted - active,
        "replay, s": replay_s,
        "start from the snapshot, s": start_s,
        "replay equal": float(replayed == started == state),
    }


def _started(store: Path, snapshot_events: int) -> tuple[float, Infrastructure]:
    """Return the time that a service needs to read its log, and the records of the service."""
    began_s = time.perf_counter()
    log = EventLog(EventStore(store), snapshot_events=snapshot_events)
    took_s = time.perf_counter() - began_s
    log.store.close()
    return took_s, log.state


if __name__ == "__main__":
    run(measure)
