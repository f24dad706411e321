"""Parts shared by routes: roles, names in paths, and documentation of responses."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path

from cavmarl.service import request_bodies
from cavmarl.service.error_names import PROBLEM_SCHEMA, PROBLEM_TYPE
from cavmarl.service.route_access import DurableRoute, may, open_to_all
from cavmarl.service.service_records import IdentityRecord

OCTETS = "application/octet-stream"
PROBLEM: dict[int | str, dict[str, Any]] = {
    status: {"description": "A problem", "content": {PROBLEM_TYPE: {"schema": PROBLEM_SCHEMA}}}
    for status in ("default", 422)
}
BYTES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "Content",
        "content": {OCTETS: {"schema": {"type": "string"}}},
    }
}
CONTENT = {  # OpenAPI schema of a request whose body is bytes
    "requestBody": {
        "required": True,
        "content": {OCTETS: {"schema": {"type": "string"}}},
    }
}


def make_router(prefix: str, tag: str) -> APIRouter:
    """Return a router whose answers are sent when the events they refer to are on disk."""
    return APIRouter(prefix=prefix, route_class=DurableRoute, tags=[tag], responses=PROBLEM)


Everyone = Annotated[IdentityRecord, Depends(may("viewer", "client", "operator", "admin", "node"))]
Viewers = Annotated[IdentityRecord, Depends(may("viewer", "operator", "admin"))]
Readers = Annotated[IdentityRecord, Depends(may("viewer", "client", "operator", "admin"))]
Clients = Annotated[IdentityRecord, Depends(may("client", "operator", "admin"))]
Operators = Annotated[IdentityRecord, Depends(may("operator", "admin"))]
Drainers = Annotated[IdentityRecord, Depends(may("operator", "admin", "node"))]
Admins = Annotated[IdentityRecord, Depends(may("admin"))]
Nodes = Annotated[IdentityRecord, Depends(may("node"))]
Anybody = Annotated[IdentityRecord, Depends(open_to_all())]
Exchangers = Annotated[IdentityRecord, Depends(open_to_all(is_limited=False))]

NodeName = Annotated[request_bodies.Name, Path()]
SessionId = Annotated[str, Path(pattern=r"^s-[0-9a-f]{24}$")]
FileName = Annotated[request_bodies.Name, Path()]
