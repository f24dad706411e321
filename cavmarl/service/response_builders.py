"""Builders of the responses of routes from the broker's records."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from dataclasses import asdict

from cavmarl.service import response_bodies
from cavmarl.service.broker import Broker
from cavmarl.service.node_selection import NoNodeError, score_of
from cavmarl.service.route_access import Service
from cavmarl.service.service_records import (
    IdentityRecord,
    LogEvent,
    NodeRecord,
    SessionRecord,
)

TLS = "tls"  # capability of nodes whose client port has TLS
KEEP_ALIVE_S = 15.0


async def assigned(
    service: Service,
    identity: IdentityRecord,
    subject: str,  # subject of the event that is recorded if no node is found
    take: Callable[[], SessionRecord],
    wait_s: float,
) -> response_bodies.Assignment:
    """Return what a client needs to reach its world; wait at most `wait_s` for a node."""
    broker = service.broker
    try:
        session = take()
    except NoNodeError as error:
        if wait_s <= 0.0:
            broker.refuse(identity, subject, error)
            raise
        with service.holding(identity):
            session = await _awaited(broker, identity, subject, take, wait_s)
    node = broker.log.state.nodes[session.node or ""]
    lease_s = broker.rules.lease_s
    return response_bodies.Assignment(
        session=session.id,
        requested=session.preferred,
        assigned=node.name,
        redirected=session.preferred not in (None, node.name),
        reason=session.reason,
        score=session.score,
        excluded=[response_bodies.Excluded(**one) for one in session.excluded],
        excluded_count=session.excluded_count,
        scheme="https" if TLS in node.capabilities else "http",
        address=node.address,
        client_port=node.client_port,
        simulator_port=node.simulator_port,
        configuration=session.configuration,
        lease_s=lease_s,
        expires_s=broker.log.wall_s() + lease_s,
        token=service.access.session_token(session, lease_s),
    )


async def _awaited(
    broker: Broker,
    identity: IdentityRecord,
    subject: str,
    take: Callable[[], SessionRecord],
    wait_s: float,
) -> SessionRecord:
    """Return a session as soon as a node can accept it; raise NoNodeError at the deadline."""
    until_s = time.monotonic() + wait_s
    await broker.log.settle()
    broker.waiting += 1
    try:
        while True:
            left_s = until_s - time.monotonic()
            with suppress(TimeoutError):
                async with asyncio.timeout(max(left_s, 0.0)), broker.log.changed:
                    await broker.log.changed.wait()
            is_late = time.monotonic() >= until_s
            if not is_late and not broker.jobs.may_try():
                continue
            try:
                return take()
            except NoNodeError as error:
                broker.jobs.has_failed()
                if is_late:
                    broker.refuse(identity, subject, error, wait_s)
                    raise
    finally:
        broker.waiting -= 1


def node_answer(service: Service, node: NodeRecord) -> response_bodies.NodeStatus:
    """Return a node with the values of its last heartbeat."""
    live = service.broker.live[node.name]
    return response_bodies.NodeStatus(
        **asdict(node),
        load=None if live.use is None else response_bodies.Load(**asdict(live.use)),
        score=score_of(node, live, service.broker.rules.load),
        limits=service.broker.limits_of(node.name),
        sessions=len(live.hosted),
        zones_of=list(live.zones_of),
        age_s=round(service.broker.age_s(node.name), 3),
    )


def session_answer(service: Service, session: SessionRecord) -> response_bodies.Session:
    """Return a session or a job, without the fields that only its node needs."""
    found = asdict(session)
    del found["saved_blob"], found["owners"], found["losses"]
    live = service.broker.live.get(session.node or "")
    progress = None if live is None else live.jobs.get(session.id)
    waits_for = service.broker.jobs.reason_of(session)
    return response_bodies.Session(**found, progress=progress, waits_for=waits_for)


def event_answer(line: LogEvent) -> response_bodies.EventLine:
    """Return a line of the log without its private part."""
    found = line._asdict()
    del found["private"]
    return response_bodies.EventLine(**found)


async def event_stream(
    service: Service, identity: IdentityRecord, after: int
) -> AsyncIterator[str]:
    """Yield the events after a number, and then new events, as server-sent events."""
    log = service.broker.log
    owner = identity.id if identity.role == "client" else None
    generation = identity.generation
    with service.holding(identity):
        while identity.generation == generation:  # else tokens were revoked: end the stream
            last = log.durable
            for line in log.store.read(after, until=last, owner=owner) if last > after else ():
                text = event_answer(line).model_dump_json()
                yield f"id: {line.sequence}\nevent: {line.kind}\ndata: {text}\n\n"
            after = max(after, last)
            if log.durable > after:
                continue
            try:
                async with asyncio.timeout(KEEP_ALIVE_S), log.changed:
                    await log.changed.wait()
            except TimeoutError:
                yield ": still here\n\n"
