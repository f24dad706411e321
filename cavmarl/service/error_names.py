"""Names and meanings of the problems with which the service refuses requests."""

from __future__ import annotations

import re

from cavmarl.core.errors import ServiceError

PROBLEM_TYPE = "application/problem+json"
PROBLEM_SCHEMA = {
    "type": "object",
    "required": ["type", "title", "status", "detail", "cure"],
    "properties": {
        "type": {"type": "string"},
        "title": {"type": "string"},
        "status": {"type": "integer"},
        "detail": {"type": "string"},
        "cure": {"type": "string"},
    },
}

# name → HTTP status, meaning and remedy
PROBLEMS = {
    "bad-body": (
        422,
        "the body or a parameter has an unknown field, a wrong type or a wrong value",
    ),
    "refused": (422, "cavmarl refuses the input; the message names the place and the remedy"),
    "bad-token": (401, "the token is missing, expired, revoked or forged: get another token"),
    "forbidden": (403, "this identity may not do this"),
    "not-found": (404, "the name does not exist, or belongs to another identity"),
    "wrong-method": (405, "the path does not support this method"),
    "slow-body": (408, "the body was not received in time: send it at once"),
    "conflict": (409, "the request conflicts with the current state, which the message names"),
    "stale-beat": (409, "the heartbeat is older than the last one: increase its number"),
    "superseded": (409, "a newer process of the node has registered: this process must end"),
    "lost": (410, "the session is not on this node: resolve it again"),
    "damaged": (410, "stored content was changed, or a state cannot be used: open another session"),
    "too-large": (413, "the body is larger than the limit"),
    "quota": (
        409,
        "a quota of this identity, which the message names, is exceeded: delete a file",
    ),
    "too-many": (429, "too many requests: wait for the time in Retry-After"),
    "broken": (500, "the service has an internal error; its log has the place"),
    "paused": (503, "a page has paused the session: repeat the request after Retry-After"),
    "no-node": (503, "no node can accept the request now: repeat it after Retry-After"),
    "unreachable": (503, "the node cannot reach the service: repeat the request after Retry-After"),
}

# An absolute path with at least two parts, except the paths of routes and of URLs.
_PATH = re.compile(r"(?<![\w.~:/-])/(?!v1/)(?:[^\s/'\",:;()\[\]]+/)+([^\s/'\",:;()\[\]]*)")


def problem(name: str, detail: str, retry_s: float | None = None) -> ServiceError:
    """Return the error of a problem; routes raise it."""
    error = ServiceError(detail, PROBLEMS[name][0], name)
    error.retry_s = retry_s
    return error


def without_folders(text: str) -> str:
    """Return a text for clients, in which absolute paths are reduced to file names."""
    return _PATH.sub(r"\1", text)
