"""Why the service refuses a request: the names that answers carry."""

from __future__ import annotations

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

# name → status, what it means and what to do
PROBLEMS = {
    "bad-body": (422, "the body or a parameter has an unknown field, a wrong type or value"),
    "refused": (422, "cavmarl refuses it; the message has the place and the cure"),
    "bad-token": (401, "no token, or one that is expired, revoked or forged: get another"),
    "forbidden": (403, "the role, or the owner, may not do this"),
    "not-found": (404, "there is nothing of that name, or it is another's"),
    "wrong-method": (405, "the path does not take this method"),
    "slow-body": (408, "the body did not come in time: send it at once"),
    "conflict": (409, "it does not fit the state: the message says which"),
    "stale-beat": (409, "a beat older than the last one: count beats up"),
    "superseded": (409, "the node has registered anew since: this process has to end"),
    "lost": (410, "the session is not on this node: resolve it again"),
    "too-large": (413, "the body is larger than is taken here"),
    "too-many": (429, "too many requests, or too many of a kind: wait, see Retry-After"),
    "broken": (500, "a fault of the service; its log has the traceback"),
    "paused": (503, "a page holds the session: ask again after Retry-After"),
    "no-node": (503, "no node can take it now: try again after Retry-After"),
}


def problem(name: str, detail: str, retry_s: float | None = None) -> ServiceError:
    """The error of that name; routes raise it."""
    error = ServiceError(detail, PROBLEMS[name][0], name)
    error.retry_s = retry_s
    return error
