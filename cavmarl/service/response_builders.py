"""How the answers of routes are made of what the broker knows."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from dataclasses import asdict

from cavmarl.service import responses
from cavmarl.service.auth import Service
from cavmarl.service.broker import Broker
from cavmarl.service.node_selection import NoNodeError, score_of
from cavmarl.service.service_records import (
    IdentityRecord,
    LogEvent,
    NodeRecord,
    SessionRecord,
)

TLS = "tls"  # the capability of nodes whose clients' port has it
KEEP_ALIVE_S = 15.0


async def assigned(
    service: Service,
    identity: IdentityRecord,
    subject: str,  # of the event, if there is no node
    take: Callable[[], SessionRecord],
    wait_s: float,
) -> responses.Assignment:
    """What a client needs to reach its world; it waits for a node until a deadline."""
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
    return responses.Assignment(
        session=session.id,
        requested=session.preferred,
        assigned=node.name,
        redirected=session.preferred not in (None, node.name),
        reason=session.reason,
        score=session.score,
        excluded=[responses.Excluded(**one) for one in session.excluded],
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
    """A session, when a node can take it; raises NoNodeError at the deadline."""
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


def node_answer(service: Service, node: NodeRecord) -> responses.NodeStatus:
    """A node, with what its last beat said."""
    live = service.broker.live[node.name]
    return responses.NodeStatus(
        **asdict(node),
        load=None if live.use is None else responses.Load(**asdict(live.use)),
        score=score_of(node, live),
        sessions=len(live.hosted),
        zones_of=list(live.zones_of),
        age_s=round(service.broker.age_s(node.name), 3),
    )


def session_answer(service: Service, session: SessionRecord) -> responses.Session:
    """A session or a job, without what only its node needs."""
    found = asdict(session)
    del found["saved_blob"], found["owners"]
    live = service.broker.live.get(session.node or "")
    progress = None if live is None else live.jobs.get(session.id)
    return responses.Session(**found, progress=progress)


def event_answer(line: LogEvent) -> responses.EventLine:
    """A line of the log, without what is never shown."""
    found = line._asdict()
    del found["private"]
    return responses.EventLine(**found)


async def event_stream(
    service: Service, identity: IdentityRecord, after: int
) -> AsyncIterator[str]:
    """Server-sent events: those that there are after a number, and then those that come."""
    log = service.broker.log
    owner = identity.id if identity.role == "client" else None
    generation = identity.generation
    with service.holding(identity):
        while identity.generation == generation:  # its tokens are void: it hears no more
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
