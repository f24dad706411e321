"""The routes of the service and the roles that may use them."""

from __future__ import annotations

from typing import Annotated

from fastapi import Header, Path, Query, Request, Response
from fastapi.responses import JSONResponse, PlainTextResponse, StreamingResponse

from cavmarl.service import configurations, request_bodies, response_bodies
from cavmarl.service.artefact_routes import artefacts
from cavmarl.service.error_names import problem, without_folders
from cavmarl.service.ownership_routes import ownership
from cavmarl.service.response_builders import (
    assigned,
    event_answer,
    event_stream,
    node_answer,
    session_answer,
)
from cavmarl.service.route_access import TheService
from cavmarl.service.route_common import (
    BYTES,
    CONTENT,
    Admins,
    Anybody,
    Clients,
    Drainers,
    Everyone,
    Exchangers,
    FileName,
    NodeName,
    Nodes,
    Operators,
    Readers,
    SessionId,
    Viewers,
    make_router,
)
from cavmarl.service.service_records import STATE_HEADER, SessionRecord
from cavmarl.service.training_settings import CAPABILITY, check_training

open_routes = make_router("/v1", "open")
nodes = make_router("/v1/nodes", "nodes")
worlds = make_router("/v1", "sessions")
records = make_router("/v1", "records")
ROUTERS = (
    nodes,
    worlds,
    ownership,
    artefacts,
    records,
    open_routes,
)  # most frequent first: heartbeats

PAGE = 1000
IdempotencyKey = Annotated[
    str, Header(alias="Idempotency-Key", pattern=r"^[A-Za-z0-9-]{0,64}$")
]  # a request is carried out once per key


@open_routes.get("/health")
async def health(_: Anybody, service: TheService) -> response_bodies.Health:
    """Return whether the service is running, and the number of its events."""
    return response_bodies.Health(status="ok", events=service.broker.log.sequence)


@open_routes.get("/keys")
async def keys(_: Anybody, service: TheService) -> response_bodies.PublicKeys:
    """Return the public keys that verify tokens, as a JSON Web Key Set."""
    return response_bodies.PublicKeys(**service.access.public_keys())


@open_routes.post("/token")
async def token(
    _: Exchangers,
    service: TheService,
    request: Request,
    body: request_bodies.SecretBody | request_bodies.RefreshBody,
) -> response_bodies.Tokens:
    """Return an access token and a refresh token for a secret or for a refresh token."""
    access, admit = service.access, service.admit_exchange
    with service.counting_wrong_secrets(request):
        if isinstance(body, request_bodies.SecretBody):
            return response_bodies.Tokens(**access.exchange(body.secret, admit))
        return response_bodies.Tokens(**access.refresh(body.refresh_token, admit))


@open_routes.delete("/token", status_code=204)
async def withdraw(identity: Everyone, service: TheService) -> None:
    """Revoke all tokens of the caller."""
    service.access.withdraw(identity)


@nodes.post(
    "/{name}/beat", response_model=response_bodies.Duties
)  # the answer is not validated, as heartbeats are frequent
async def beat(
    identity: Nodes, service: TheService, name: NodeName, body: request_bodies.BeatBody
) -> JSONResponse:
    """Record a heartbeat of a node; the answer lists what it has to do."""
    found = service.broker.beat(identity, name, body)
    if service.broker.waiting:
        await service.broker.log.stir()
    return JSONResponse(found)


@nodes.get("")
async def list_nodes(_: Readers, service: TheService) -> response_bodies.NodeList:
    """Return all nodes with the values of their last heartbeats."""
    known = service.broker.log.state.nodes.values()
    return response_bodies.NodeList(nodes=[node_answer(service, one) for one in known])


@nodes.post("", status_code=201)
async def register(
    identity: Nodes, service: TheService, body: request_bodies.NodeBody
) -> response_bodies.NodeStatus:
    """Register a node, or register it again after it left, failed or restarted."""
    return node_answer(service, service.broker.register(identity, body))


@nodes.post("/{name}/drain")
async def drain(
    identity: Drainers, service: TheService, name: NodeName
) -> response_bodies.NodeStatus:
    """Assign nothing more to a node, and move its sessions."""
    return node_answer(service, service.broker.drain(identity, name))


@nodes.post("/{name}/resume")
async def resume(
    identity: Operators, service: TheService, name: NodeName
) -> response_bodies.NodeStatus:
    """Let a drained node accept sessions again."""
    return node_answer(service, service.broker.drain(identity, name, is_on=False))


@nodes.delete("/{name}")
async def leave(
    identity: Drainers, service: TheService, name: NodeName
) -> response_bodies.NodeStatus:
    """Remove a node."""
    return node_answer(service, service.broker.leave(identity, name))


@worlds.post("/configurations", status_code=201)
async def add_configuration(
    identity: Clients, service: TheService, body: request_bodies.ConfigurationBody
) -> response_bodies.Configuration:
    """Check and store a configuration; new content gets a new version."""
    broker = service.broker
    log, known = broker.log, broker.artefacts
    new = configurations.collect_configuration(log, identity, body, known)
    if new.contents:
        await known.check(new.check)
    else:
        new.check()
    found = configurations.add_configuration(log, identity, new)
    return response_bodies.Configuration(**found)


@worlds.get("/configurations/{sha256}")
async def get_configuration(
    _: Everyone, service: TheService, sha256: Annotated[request_bodies.Sha256, Path()]
) -> request_bodies.ConfigurationBody:
    """Return a configuration by its hash."""
    return request_bodies.ConfigurationBody(
        **configurations.read_configuration(service.broker.log, sha256)
    )


@worlds.post("/sessions", status_code=201)
async def open_session(
    identity: Clients,
    service: TheService,
    body: request_bodies.SessionBody,
    key: IdempotencyKey = "",
) -> response_bodies.Assignment:
    """Open a session on the admissible node with the lowest LoadScore, or on a preferred node."""
    found = configurations.read_configuration(service.broker.log, body.configuration)

    def opened() -> SessionRecord:
        return service.broker.open(
            identity,
            body.configuration,
            preferred=body.node,
            needs=body.needs,
            zone_nodes=found.get("nodes") or 0,
            key=key,
        )

    return await assigned(service, identity, body.configuration, opened, body.wait_s)


@worlds.post("/sessions/{number}/resolve")
async def resolve(
    identity: Clients, service: TheService, number: SessionId, body: request_bodies.ResolveBody
) -> response_bodies.Assignment:
    """Return where a session is now, with a new lease."""

    def resolved() -> SessionRecord:
        return service.broker.resolve(identity, number, body.unreachable)

    return await assigned(service, identity, number, resolved, body.wait_s)


@worlds.get("/sessions")
async def list_sessions(identity: Readers, service: TheService) -> response_bodies.SessionList:
    """Return sessions and jobs; a client gets only its own."""
    found = service.broker.log.state.sessions.values()
    own = [one for one in found if identity.role != "client" or one.owner == identity.id]
    return response_bodies.SessionList(sessions=[session_answer(service, one) for one in own])


@worlds.get("/sessions/{number}")
async def get_session(
    identity: Readers, service: TheService, number: SessionId
) -> response_bodies.Session:
    """Return a session or a job."""
    return session_answer(service, service.broker.session(identity, number))


@worlds.delete("/sessions/{number}")
async def close_session(
    identity: Clients, service: TheService, number: SessionId
) -> response_bodies.Session:
    """End a session or a job."""
    return session_answer(service, service.broker.close(identity, number))


@worlds.get(
    "/sessions/{number}/state",
    response_class=Response,
    responses={**BYTES, 204: {"description": "Nothing was saved yet"}},
)
async def get_state(identity: Nodes, service: TheService, number: SessionId) -> Response:
    """Return the newest saved state of a session to the node that hosts it."""
    session = service.broker.hosted(identity, number)
    if session.saved_blob is None:
        return Response(status_code=204)
    content = service.broker.log.content(session.saved_blob)
    signature = service.access.state_token(session, session.saved_number, content)
    headers = {"Cavmarl-Number": str(session.saved_number), STATE_HEADER: signature}
    return Response(content, headers=headers, media_type="application/octet-stream")


@worlds.put("/sessions/{number}/state", status_code=204, openapi_extra=CONTENT)
async def put_state(
    identity: Nodes,
    service: TheService,
    request: Request,
    number: SessionId,
    at: Annotated[request_bodies.Whole, Query()],
) -> None:
    """Store the state of a session after a number of commands."""
    content = await request.body()
    service.broker.save(service.broker.hosted(identity, number), at, content)


@worlds.post("/jobs", status_code=201)
async def submit(
    identity: Clients, service: TheService, body: request_bodies.JobBody, key: IdempotencyKey = ""
) -> response_bodies.Session:
    """Evaluate drivers on a node; the job waits if no node is free."""
    found = configurations.read_configuration(service.broker.log, body.configuration)
    if found.get("nodes"):
        raise problem("refused", "nodes: an evaluation runs on one node; remove the key")
    configurations.check_policies(body.policies, found.get("files"))
    session = service.broker.open(
        identity,
        body.configuration,
        preferred=body.node,
        needs=body.needs,
        job=body.model_dump(include={"policies", "episodes", "repeats"}),
        wait_s=body.wait_s,
        key=key,
    )
    return session_answer(service, session)


@worlds.post("/trainings", status_code=201)
async def train(
    identity: Clients,
    service: TheService,
    body: request_bodies.TrainingBody,
    key: IdempotencyKey = "",
) -> response_bodies.Session:
    """Train a driver on a node that offers it; the job waits if no node is free."""
    found = configurations.read_configuration(service.broker.log, body.configuration)
    check_training(found, body.settings)
    session = service.broker.open(
        identity,
        body.configuration,
        preferred=body.node,
        needs=[*body.needs, CAPABILITY],
        job=body.model_dump(include={"settings"}),
        wait_s=body.wait_s,
        key=key,
    )
    return session_answer(service, session)


@worlds.post("/jobs/{number}/outcome")
async def finish(
    identity: Nodes, service: TheService, number: SessionId, body: request_bodies.OutcomeBody
) -> response_bodies.Session:
    """Record the outcome of a job."""
    session = service.broker.hosted(identity, number)
    service.broker.finish(session, body.status, without_folders(body.message))
    return session_answer(service, session)


@worlds.put("/jobs/{number}/results/{name}", status_code=204, openapi_extra=CONTENT)
async def put_result(
    identity: Nodes, service: TheService, request: Request, number: SessionId, name: FileName
) -> None:
    """Store a file that a job has produced."""
    content = await request.body()
    service.broker.add_result(service.broker.hosted(identity, number), name, content)


@worlds.get("/jobs/{number}/results/{name}", response_class=Response, responses=BYTES)
async def get_result(
    identity: Readers, service: TheService, number: SessionId, name: FileName
) -> Response:
    """Return a file that a job has produced."""
    results = service.broker.session(identity, number).results
    if name not in results:
        raise problem("not-found", f"there is no result '{name}': choose one of {sorted(results)}")
    content = service.broker.log.content(results[name])
    return Response(content, media_type="application/octet-stream")


@records.get("/events")
async def events(
    identity: Readers,
    service: TheService,
    after: Annotated[request_bodies.Whole, Query()] = 0,
    limit: Annotated[int, Query(ge=1, le=PAGE)] = 100,
    subject: Annotated[request_bodies.Subject | None, Query()] = None,
) -> response_bodies.EventList:
    """Return events after a sequence number; a client gets only its own events."""
    owner = identity.id if identity.role == "client" else None
    await service.broker.log.settle()
    found = service.broker.log.store.read(after, limit, owner=owner, subject=subject)
    return response_bodies.EventList(events=list(map(event_answer, found)))


@records.get("/events/stream", response_class=StreamingResponse)
async def stream(
    identity: Readers,
    service: TheService,
    request: Request,
    after: Annotated[request_bodies.Whole, Query()] = 0,
) -> StreamingResponse:
    """Send events as server-sent events; `Last-Event-ID` continues an earlier stream."""
    last = request.headers.get("last-event-id", "")
    after = int(last) if last.isascii() and last.isdigit() and len(last) < 19 else after
    with service.holding(identity):  # refuse it here, while the client still waits for an answer
        lines = event_stream(service, identity, after)
    return StreamingResponse(lines, media_type="text/event-stream")


@records.get("/metrics", response_class=PlainTextResponse)
async def metrics(_: Viewers, request: Request) -> PlainTextResponse:
    """Return the metrics of the service in the format of Prometheus."""
    return PlainTextResponse(request.app.state.metrics.text(), media_type="text/plain")


@records.post("/identities", status_code=201)
async def add_identity(
    identity: Admins, service: TheService, body: request_bodies.IdentityBody
) -> response_bodies.NewIdentity:
    """Create an identity and return its secret, which is not shown again."""
    found, secret = service.access.add_identity(body.name, body.role, identity.id)
    return response_bodies.NewIdentity(
        identity=found.id, name=found.name, role=found.role, secret=secret
    )


@records.get("/identities")
async def list_identities(_: Admins, service: TheService) -> response_bodies.IdentityList:
    """Return all identities."""
    known = service.broker.log.state.identities.values()
    shown = [
        response_bodies.Identity(id=one.id, name=one.name, role=one.role, revoked=one.revoked)
        for one in known
    ]
    return response_bodies.IdentityList(identities=shown)


@records.delete("/identities/{number}", status_code=204)
async def revoke(
    identity: Admins,
    service: TheService,
    number: Annotated[str, Path(pattern=r"^id-[0-9a-f]{16}$")],
) -> None:
    """Revoke an identity, its secret and its tokens."""
    service.access.revoke(number, identity.id)


@records.post("/keys", status_code=201)
async def rotate(identity: Admins, service: TheService) -> response_bodies.NewKey:
    """Sign tokens with a new key; tokens of the previous key stay valid."""
    return response_bodies.NewKey(key=service.access.rotate_key(identity.id))
