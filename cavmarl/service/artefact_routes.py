"""Routes of artefacts: files that users upload for their own configurations."""

from __future__ import annotations

from functools import partial
from typing import Annotated

from fastapi import Path, Query, Request, Response
from pydantic import StringConstraints

from cavmarl.service import request_bodies, response_bodies
from cavmarl.service.artefacts import check_content
from cavmarl.service.route_access import TheService
from cavmarl.service.route_common import (
    BYTES,
    CONTENT,
    Clients,
    Everyone,
    Readers,
    make_router,
)
from cavmarl.service.service_records import ArtefactRecord

artefacts = make_router("/v1/artefacts", "artefacts")

Digest = Annotated[request_bodies.Sha256, Path()]
Licence = Annotated[str, StringConstraints(max_length=200, pattern=r"^[^\x00-\x1f]*$"), Query()]


def _answer(owner: str, sha256: str, one: ArtefactRecord) -> response_bodies.Artefact:
    return response_bodies.Artefact(
        sha256=sha256,
        owner=owner,
        name=one.name,
        licence=one.licence,
        size_bytes=one.size_bytes,
        until_s=one.until_s,
    )


@artefacts.get("")
async def list_artefacts(
    identity: Readers,
    service: TheService,
    own: Annotated[bool, Query(description="Return only artefacts of the caller")] = False,
) -> response_bodies.ArtefactList:
    """Return artefacts; a client gets only its own."""
    known = service.broker.log.state.artefacts.items()
    shown = [
        _answer(owner, sha256, one)
        for owner, some in known
        if (identity.role != "client" and not own) or owner == identity.id
        for sha256, one in some.items()
    ]
    return response_bodies.ArtefactList(artefacts=shown)


@artefacts.put("/{sha256}", openapi_extra=CONTENT)
async def put_artefact(
    identity: Clients,
    service: TheService,
    request: Request,
    sha256: Digest,
    name: Annotated[request_bodies.Name, Query()],
    licence: Licence = "",
) -> response_bodies.Artefact:
    """Store a file of data under its SHA-256, or extend its lifetime; code is refused."""
    content, known = await request.body(), service.broker.artefacts
    known.check_quota(identity, sha256, len(content))
    await known.check(partial(check_content, name, sha256, content))
    found = known.add(identity, sha256, name, licence, content)
    return _answer(identity.id, sha256, found)


@artefacts.get("/{sha256}", response_class=Response, responses=BYTES)
async def get_artefact(identity: Everyone, service: TheService, sha256: Digest) -> Response:
    """Return a file to its owner, or to a node that hosts a session or job that needs it."""
    content = service.broker.artefacts.content(identity, sha256)
    return Response(content, media_type="application/octet-stream")


@artefacts.delete("/{sha256}", status_code=204)
async def delete_artefact(identity: Clients, service: TheService, sha256: Digest) -> None:
    """Delete a file of the caller that no open session or job needs."""
    service.broker.artefacts.delete(identity, sha256)
