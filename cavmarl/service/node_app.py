"""The HTTP interface of a node: worlds of sessions, opened with the tokens of their leases.

A token names the session, its node and the node's incarnation, which is the number of times that
the node has registered. The service has signed it, so the node needs no other authority. The node
saves a session's state with the service before it executes a command, never after it, so a saved
state never includes a command whose answer may have been lost.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Annotated, Any

import jwt
from fastapi import APIRouter, Depends, FastAPI, Query, Request, Response
from fastapi.openapi.models import HTTPBearer
from fastapi.security.base import SecurityBase
from starlette.types import ASGIApp

from cavmarl.client.world_protocol import SAVED_HEADER
from cavmarl.core.errors import CapacityError, CavmarlError, ServiceError, WorkerError
from cavmarl.service import response_bodies
from cavmarl.service.app import NO_TELEMETRY, GuardedRequests
from cavmarl.service.change_bodies import Change
from cavmarl.service.error_names import problem
from cavmarl.service.node_link import NodeLink
from cavmarl.service.problem_json import serve_routes
from cavmarl.service.request_bodies import Whole
from cavmarl.service.route_access import StrictRoute
from cavmarl.service.route_common import OCTETS, PROBLEM
from cavmarl.service.session_worlds import SAVED_EVERY, SessionWorld, SessionWorlds

MAX_ACTIONS_BYTES = 16 * 1024 * 1024
HOLD_S = 5.0  # how long a command waits for a paused session before the client must ask again
TEND_S = 0.1  # time between two checks for requests of pages

router = APIRouter(
    prefix="/v1/worlds/{session}", route_class=StrictRoute, responses=PROBLEM, tags=["worlds"]
)

ARRAYS = "An .npz of numpy, without compression: {}"
OF_STEPS = (
    "observations, rewards, terminations, truncations, infos/…; a Dict space has an array per key"
)
ANSWER: dict[int | str, dict[str, Any]] = {
    200: {
        "description": ARRAYS.format(OF_STEPS),
        "content": {OCTETS: {"schema": {"type": "string", "format": "binary"}}},
        "headers": {
            "Cavmarl-Saved": {
                "description": "Number of commands in the saved state; keep the later commands",
                "schema": {"type": "integer"},
            }
        },
    }
}
STATE: dict[int | str, dict[str, Any]] = {
    200: {**ANSWER[200], "description": "The state, for `load_state` of a vector environment"}
}
ACTIONS = {
    "requestBody": {
        "required": True,
        "description": "The actions: `action.shape` numbers of `action.dtype`, little-endian, in C "
        "order",
        "content": {OCTETS: {"schema": {"type": "string", "format": "binary"}}},
    }
}
Number = Annotated[
    int, Query(ge=1, description="Number of the command; a repeated number gets the same answer")
]
Quiet = Annotated[bool, Query(description="Return no content, as the client already has it")]


def _link(request: Request) -> NodeLink:
    found: NodeLink = request.app.state.link
    return found


class Lease(SecurityBase):
    """A dependency that admits the token of a session's lease and returns its configuration."""

    model = HTTPBearer(bearerFormat="JWT", description="The `token` of an Assignment")
    scheme_name = "lease"

    async def __call__(self, request: Request, session: str) -> str:
        link = _link(request)
        kind, _, token = request.headers.get("authorization", "").partition(" ")
        try:
            with _needing_the_service():
                bearer = token if kind.lower() == "bearer" else ""
                claims = await link.claims(bearer, "session", session)
        except (jwt.InvalidTokenError, KeyError):
            raise problem(
                "bad-token", "the token of this session's lease is missing: resolve the session"
            ) from None
        if claims["inc"] != link.incarnation:
            raise problem(
                "lost", "the token belongs to an earlier process of this node: resolve again"
            )
        return str(claims["cfg"])


Opened = Annotated[str, Depends(Lease())]


def make_node_app(link: NodeLink, worlds: SessionWorlds) -> ASGIApp:
    """Return the application of a node."""
    app = FastAPI(
        title="cavmarl node",
        version="1",
        openapi_url="/v1/openapi.json",
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
        telemetry=NO_TELEMETRY,
    )
    app.state.link, app.state.worlds, app.state.tended = link, worlds, {}
    serve_routes(app, [router])
    return GuardedRequests(app, body_bytes=MAX_ACTIONS_BYTES)


def _worlds(request: Request) -> SessionWorlds:
    found: SessionWorlds = request.app.state.worlds
    return found


@router.post("")
async def open_worlds(
    request: Request,
    session: str,
    configuration: Opened,
    save: Annotated[bool, Query(description="Store the state with the service first")] = False,
) -> response_bodies.WorldDescription:
    """Create or find the worlds of a session; they continue from their saved state."""
    link, worlds = _link(request), _worlds(request)
    if session not in worlds:
        with _needing_the_service():
            await _begin(link, worlds, session, configuration)
    elif save:
        await _save(link, worlds, session)
    return response_bodies.WorldDescription(**worlds[session].describe())


async def _begin(link: NodeLink, worlds: SessionWorlds, session: str, configuration: str) -> None:
    """Create the worlds of a session; a session whose content cannot be used ends as failed."""
    files, is_own = None, False  # files of the client, which may be unusable
    try:
        document = await link.configuration(configuration)
        is_own = bool(document.get("files"))
        state, number = await link.saved_state(session)
        files = await link.fetch_files(document)
        keys = await link.open_door(session, document)
        await asyncio.to_thread(worlds.add, session, document, state, number, keys, files)
    except WorkerError as error:
        raise problem("lost", f"its zone nodes are lost: {error}") from error
    except CapacityError:
        raise
    except CavmarlError as error:
        is_useless = is_own and not isinstance(error, ServiceError)
        if is_useless or (isinstance(error, ServiceError) and error.problem == "damaged"):
            with suppress(ServiceError):  # another node has it, or the service ends it later
                await link.fail(session, str(error))
        raise
    finally:
        link.close_key_file(session)
        if files is not None and not (session in worlds and worlds[session].has_files(files)):
            files.cleanup()
    link.expect(session)


@contextmanager
def _needing_the_service() -> Iterator[None]:
    """Let clients repeat a request for which the node cannot reach the service."""
    try:
        yield
    except ServiceError as error:
        if error.status:
            raise
        raise problem("unreachable", "the service does not answer this node", 1.0) from error


@router.post("/reset", response_class=Response, responses=ANSWER)
async def reset(
    request: Request,
    session: str,
    _: Opened,
    number: Number,
    seed: Annotated[Whole | None, Query(description="None: the next episodes")] = None,
    quiet: Quiet = False,
) -> Response:
    """Start an episode in every world."""

    def act() -> bytes:
        return _worlds(request)[session].reset(seed)

    return await _command(request, session, number, act, quiet)


@router.post("/step", response_class=Response, responses=ANSWER, openapi_extra=ACTIONS)
async def step(
    request: Request, session: str, _: Opened, number: Number, quiet: Quiet = False
) -> Response:
    """Step all worlds with one action per agent."""
    content = await request.body()
    worlds = _worlds(request)

    def act() -> bytes:
        answer = worlds[session].step(content)
        worlds.count_step(session)
        return answer

    return await _command(request, session, number, act, quiet)


@router.post("/change", response_class=Response, responses=ANSWER)
async def change(
    request: Request, session: str, _: Opened, number: Number, body: Change, quiet: Quiet = False
) -> Response:
    """Change the worlds between two steps: insert a vehicle, close a road, record them."""

    def act() -> bytes:
        return _worlds(request)[session].change(body)

    return await _command(request, session, number, act, quiet)


async def _command(
    request: Request, session: str, number: int, act: Callable[[], bytes], is_quiet: bool
) -> Response:
    link, worlds = _link(request), _worlds(request)
    world = worlds[session]
    if number == world.number + 1 and not is_quiet:
        await _hold(link, worlds, world)

    def command() -> bytes:
        return world.command(number, act, is_quiet)

    # Pages wait: their changes would be neither in this command nor in the saved state.
    world.is_commanded = True
    try:
        if number == world.number + 1:
            await _save_before(link, worlds, session)
        answer = await in_turn(worlds, command)
    except WorkerError as error:  # the nodes of its zones are lost: restart from the saved state
        await asyncio.to_thread(worlds.close, session)
        raise problem("lost", f"its zone nodes are lost: {error}") from error
    finally:
        world.is_commanded = False
    headers = {SAVED_HEADER: str(world.saved)}
    return Response(answer, headers=headers, media_type=OCTETS)


async def _hold(link: NodeLink, worlds: SessionWorlds, world: SessionWorld) -> None:
    """Wait while a page has paused the session, or until its next step is due."""
    until_s = time.monotonic() + HOLD_S
    while not link.is_draining and (wait_s := await in_turn(worlds, world.tend)):
        if time.monotonic() > until_s:
            raise problem("paused", "a page has paused the session", retry_s=1.0)
        await asyncio.sleep(min(wait_s, TEND_S))


async def _save_before(link: NodeLink, worlds: SessionWorlds, session: str) -> None:
    """Save the state before a command if it is due or a page has changed the worlds."""
    world = worlds[session]
    due = world.number - world.saved >= SAVED_EVERY
    if due or world.is_changed or link.is_draining:
        await _save(link, worlds, session)
    if link.is_draining:
        raise problem("lost", "this node is being drained: resolve the session again")
    if world.is_changed:
        detail = "a change by a page is not saved yet, as the service is unreachable"
        raise problem("paused", detail, retry_s=1.0)


async def _tend(worlds: SessionWorlds, session: str) -> None:
    """Serve the pages of a session for as long as this node hosts it."""
    while session in worlds:
        await asyncio.sleep(TEND_S)
        if session in worlds and worlds[session].is_watched:
            await in_turn(worlds, worlds[session].tend)


@router.get("/hash")
async def get_hashes(request: Request, session: str, _: Opened) -> response_bodies.WorldHashes:
    """Return the state hashes of the worlds."""
    worlds = _worlds(request)
    return response_bodies.WorldHashes(hashes=await in_turn(worlds, worlds[session].hashes))


@router.get("/suggestion", response_class=Response, responses=ANSWER)
async def get_suggestion(request: Request, session: str, _: Opened) -> Response:
    """Return the built-in driver's actions for all agents as an .npz file with `actions`."""
    worlds = _worlds(request)
    return Response(await in_turn(worlds, worlds[session].suggestion), media_type=OCTETS)


@router.get("/frames", response_class=Response, responses=ANSWER)
async def get_frames(
    request: Request,
    session: str,
    _: Opened,
    final: Annotated[bool, Query(description="Return the samples before a reset")] = False,
) -> Response:
    """Return the samples of the mounted sensors as an .npz file with `SENSOR/FIELD`."""
    worlds = _worlds(request)
    content = await in_turn(worlds, lambda: worlds[session].frames(final))
    return Response(content, media_type=OCTETS)


@router.post("/save", response_class=Response, responses=STATE)
async def save(request: Request, session: str, _: Opened) -> Response:
    """Store state and recording with the service now, and return the state of the worlds."""
    link, worlds = _link(request), _worlds(request)
    world = worlds[session]
    state = await in_turn(worlds, world.state_of_worlds)
    number = world.number
    await _save(link, worlds, session)
    if world.saved < number:
        raise problem("unreachable", "the service does not answer this node", 1.0)
    headers = {SAVED_HEADER: str(world.saved)}
    return Response(state, headers=headers, media_type=OCTETS)


@router.get("/transfers")
async def get_transfers(
    request: Request, session: str, _: Opened
) -> response_bodies.WorldTransfers:
    """Return the most recent ownership transfers of divided worlds."""
    worlds = _worlds(request)
    return response_bodies.WorldTransfers(
        transfers=await in_turn(worlds, worlds[session].transfers)
    )


@router.get("/page")
async def get_page(request: Request, session: str, _: Opened) -> response_bodies.WorldPage:
    """Serve a viewer page of the worlds on this node's machine, and return its address."""
    worlds = _worlds(request)
    told = await in_turn(worlds, worlds[session].page)
    tended: dict[str, asyncio.Task[None]] = request.app.state.tended
    if session not in tended or tended[session].done():
        tended[session] = asyncio.create_task(_tend(worlds, session))
    return response_bodies.WorldPage(**told)


@router.delete("", status_code=204)
async def close_worlds(request: Request, session: str, _: Opened) -> None:
    """Close the worlds of a session."""
    await asyncio.to_thread(_worlds(request).close, session)


async def _save(link: NodeLink, worlds: SessionWorlds, session: str) -> None:
    world = worlds[session]
    number = world.number
    was_changed = world.is_changed
    if number == world.saved and not was_changed:
        return
    state = await in_turn(worlds, world.state)
    if state is None:
        return
    try:
        await _store_parts(link, session, world)
        await link.save_state(session, number, state)
    except ServiceError as error:
        world.is_changed |= was_changed
        if error.status:
            raise
        return  # the service is unreachable: the client keeps the commands since the last state
    world.saved = number


async def _store_parts(link: NodeLink, session: str, world: SessionWorld) -> None:
    """Store the parts of a recording that have ended; a refused part ends the recording."""
    recording = world.recording
    while recording is not None and recording.waiting:
        part = recording.waiting[0]
        try:
            await link.ask("PUT", f"/jobs/{session}/results/{part.name}", content=part.content)
        except ServiceError as error:
            if error.problem not in ("too-many", "too-large"):
                raise
            world.drop_recording()
            raise problem(
                "refused",
                f"the recording has ended, as the service does not store {part.name}: {error}; "
                "earlier parts are stored, and the session continues without a recording",
            ) from error
        recording.waiting.pop(0)


async def in_turn(worlds: SessionWorlds, act: Callable[[], Any]) -> Any:
    """Run a function on the worlds in a thread, one call at a time."""

    def wait_and_act() -> Any:
        began_s = time.perf_counter()
        with worlds.lock:
            worlds.wait_s += time.perf_counter() - began_s
            return act()

    return await asyncio.to_thread(wait_and_act)
