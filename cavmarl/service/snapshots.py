"""Snapshots of the service records, from which a service starts without replaying all events.

A snapshot is sealed with the newest signing key of the service, like the head of the log.
"""

from __future__ import annotations

import hashlib
import hmac
import json
from collections import Counter
from dataclasses import fields
from importlib.metadata import version
from typing import Any, NamedTuple

from cavmarl.service.service_records import (
    ArtefactRecord,
    IdentityRecord,
    Infrastructure,
    NodeRecord,
    OwnerTable,
    SessionRecord,
)

SNAPSHOT_EVENTS = 10_000  # events between two snapshots
_RECORDS = (
    Infrastructure, NodeRecord, SessionRecord, OwnerTable, ArtefactRecord, IdentityRecord,
)  # fmt: skip
_FIELDS = json.dumps([[one.name for one in fields(record)] for record in _RECORDS])
# A service with another schema may derive other records from the events, so it replays them.
SNAPSHOT_SCHEMA = (
    f"cavmarl.snapshot/1 {version('cavmarl')} {hashlib.sha256(_FIELDS.encode()).hexdigest()[:12]}"
)


class SealedSnapshot(NamedTuple):
    """The records after an event, sealed with the service's key."""

    sequence: int  # number of the event
    digest: str  # digest of the event
    schema: str
    key: str  # id of the key
    content: str  # the records as JSON
    seal: str  # HMAC-SHA256 of the other fields

    def sealed(self, pem: str) -> SealedSnapshot:
        """Return the snapshot with the seal of a key."""
        sealed = json.dumps(["snapshot of the log", *self[:-1]], default=repr)
        seal = hmac.digest(pem.encode(), sealed.encode(), "sha256").hex()
        return self._replace(seal=seal)


def text_of(state: Infrastructure) -> str:
    """Return the records as JSON, with private data."""
    shown = {name: value for name, value in vars(state).items() if name != "unused"}
    return json.dumps(shown, default=vars, separators=(",", ":"))


def records_of(text: str) -> Infrastructure:
    """Return the records that `text_of` has written; dicts keep their order."""
    found = json.loads(text)
    made = {
        "nodes": {name: NodeRecord(**one) for name, one in found["nodes"].items()},
        "sessions": {name: _session(**one) for name, one in found["sessions"].items()},
        "identities": {name: IdentityRecord(**one) for name, one in found["identities"].items()},
        "artefacts": {
            owner: {sha256: ArtefactRecord(**one) for sha256, one in own.items()}
            for owner, own in found["artefacts"].items()
        },
        "users": Counter(found["users"]),
    }
    return Infrastructure(**{**found, **made})


def is_same(one: Infrastructure, other: Infrastructure) -> bool:
    """Return whether records are equal, including the order of dicts whose order matters."""
    ordered = [(list(each.keys), list(each.waiting), list(each.sessions)) for each in (one, other)]
    return one == other and ordered[0] == ordered[1]


def _session(owners: dict[str, dict[str, Any]], **values: Any) -> SessionRecord:
    tables = {
        world: OwnerTable(table["episode"], {int(k): v for k, v in table["zones"].items()})
        for world, table in owners.items()
    }
    return SessionRecord(owners=tables, **values)
