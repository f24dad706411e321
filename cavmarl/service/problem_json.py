"""Errors as `application/problem+json` (RFC 9457), each with its cause and its remedy."""

from __future__ import annotations

import logging
import re
import traceback
from collections import Counter
from collections.abc import Sequence
from typing import Any

from fastapi import APIRouter, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from cavmarl.core.errors import CavmarlError, ServiceError
from cavmarl.service.error_names import PROBLEM_TYPE, PROBLEMS, without_folders
from cavmarl.service.node_selection import NoNodeError

MOST_EXCLUSIONS = 100  # maximum number of excluded nodes in an answer
FAULT = "cavmarl.fault"  # key of an ASGI scope: the exception of a failed request

_BY_STATUS = {404: "not-found", 405: "wrong-method", 408: "slow-body", 413: "too-large"}
_BEAT = re.compile(r"/v1/nodes/([^/]+)/beat")
_LOGGER = logging.getLogger("cavmarl.service")


def answer(
    name: str,
    detail: str,
    *,
    status: int | None = None,
    headers: dict[str, str] | None = None,
    more: dict[str, Any] | None = None,
) -> JSONResponse:
    """Return a problem as the answer to a request."""
    known, cure = PROBLEMS[name]
    body = {
        "type": f"urn:cavmarl:problem:{name}",
        "title": name,
        "status": status or known,
        "detail": without_folders(detail),
        "cure": cure,
        **(more or {}),
    }
    return JSONResponse(body, status or known, headers, media_type=PROBLEM_TYPE)


def serve_routes(app: FastAPI, routers: Sequence[APIRouter]) -> None:
    """Add routes to an application whose errors are answered as problems."""
    app.state.rejected = Counter()
    app.state.faults = set()  # places of internal errors whose traceback was logged
    app.state.on_misreport = None  # called with heartbeats that report impossible values
    app.state.routes = [one for router in routers for one in router.routes]
    for router in routers:
        app.include_router(router)
    app.add_exception_handler(CavmarlError, _on_error)
    app.add_exception_handler(RequestValidationError, _on_validation)
    app.add_exception_handler(HTTPException, _on_http)
    app.add_exception_handler(ClientDisconnect, _on_disconnect)
    app.add_exception_handler(Exception, _on_fault)


def _refuse(request: Request, name: str, detail: str, **given: Any) -> JSONResponse:
    request.app.state.rejected[name] += 1
    return answer(name, detail, **given)


async def _on_error(request: Request, error: Exception) -> JSONResponse:
    if isinstance(error, NoNodeError):
        shown = [one._asdict() for one in error.exclusions[:MOST_EXCLUSIONS]]
        more = {"excluded": shown, "excluded_count": len(error.exclusions)}
        return _refuse(request, "no-node", str(error), headers={"Retry-After": "1"}, more=more)
    if isinstance(error, ServiceError) and error.problem:
        headers: dict[str, str] = {}
        if error.status == 401:
            headers["WWW-Authenticate"] = "Bearer"
        if error.retry_s is not None:
            headers["Retry-After"] = str(max(1, round(error.retry_s)))
        return _refuse(request, error.problem, str(error), headers=headers)
    if isinstance(error, ServiceError):
        return await _on_fault(request, error)
    return _refuse(request, "refused", str(error))


async def _on_validation(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    places = [
        f"{'.'.join(map(str, one['loc']))}: {one['msg']}{_percent(one)}"
        for one in error.errors()[:8]
    ]
    detail = "; ".join(places)
    beat = _BEAT.fullmatch(request.scope["path"])
    identity = getattr(request.state, "identity", None)  # None: the route has no `Rule`
    if beat and identity and request.app.state.on_misreport:
        request.app.state.on_misreport(identity, beat[1], detail)
    return _refuse(request, "bad-body", detail)


def _percent(found: dict[str, Any]) -> str:
    """Return a hint if a share looks like a percentage: 85 instead of 0.85."""
    value = found.get("input")
    if found["type"] == "less_than_equal" and isinstance(value, int | float) and value <= 100:
        return f" (percent? send {value / 100:g})"
    return ""


async def _on_http(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    name = _BY_STATUS.get(error.status_code, "bad-body")
    headers = dict(error.headers or {})
    if error.status_code == 405:
        headers["Allow"] = ", ".join(sorted(_methods_of(request)))
    return _refuse(request, name, str(error.detail), status=error.status_code, headers=headers)


async def _on_disconnect(request: Request, _: Exception) -> JSONResponse:
    return _refuse(request, "bad-body", "the connection was closed before the end of the body")


def _methods_of(request: Request) -> set[str]:
    """Return all methods of a path; the router itself names only the methods of its first route."""
    methods: set[str] = set()
    for route in request.app.state.routes:
        if route.path_regex.fullmatch(request.scope["path"]):
            methods |= route.methods
    return methods


async def _on_fault(request: Request, error: Exception) -> JSONResponse:
    """Log an internal error in one line, and with its traceback if it is the first at its place."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    place = f"{last.filename}:{last.lineno}"
    is_new = place not in request.app.state.faults
    request.app.state.faults.add(place)
    shown = f"{type(error).__name__} at {place}: {str(error)[:200]!r}"
    _LOGGER.error(shown, exc_info=error if is_new else None)
    request.scope[FAULT] = error
    return _refuse(request, "broken", "the service could not do this; nothing was changed")
