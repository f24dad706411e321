"""Artefacts: files that users upload for their configurations, identified by their SHA-256.

An artefact is data: a map, demand, a zone file, a configuration, or the weights of a driver. Code
is refused. Each identity has quotas. An artefact that is not used is deleted after its lifetime.
"""

from __future__ import annotations

import asyncio
import gzip
import hashlib
import json
import tempfile
import zlib
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, TypeVar
from xml.parsers import expat

from cavmarl.core.errors import CavmarlError
from cavmarl.core.xml_root import is_sumo_config, root_tag
from cavmarl.service.error_names import problem
from cavmarl.service.event_log import EventLog
from cavmarl.service.service_records import SESSION_OVER, ArtefactRecord, IdentityRecord

T = TypeVar("T")
MOST_UNPACKED_BYTES = 1 << 29  # maximum size of a compressed file when unpacked
MOST_ELEMENTS = 10_000_000  # maximum number of elements in an XML file
MOST_YAML_BYTES = 1 << 20
MOST_JSON_BYTES = 1 << 24
_HEAD_BYTES = 1 << 17
_NOWHERE = ("/dev/null", "NUL")  # usual names of the null device


@dataclass(frozen=True)
class Quota:
    """What one identity may store, and for how long."""

    files: int = 1000
    total_bytes: int = 1 << 30
    days: float = 30.0  # after the last use


class Artefacts:
    """The artefacts of a service.

    Args:
        log: the log of the service.
        quota: quota of each identity.
    """

    def __init__(self, log: EventLog, quota: Quota) -> None:
        self._log, self._quota = log, quota
        self._checks = ThreadPoolExecutor(1, "checks-of-artefacts")

    async def check(self, call: Callable[[], T]) -> T:
        """Run `call` in the thread for checks, and return its result.

        A check of large files takes seconds. All checks share one thread, so that the event loop
        and the threads that write the log can run meanwhile.
        """
        return await asyncio.get_running_loop().run_in_executor(self._checks, call)

    def add(
        self, identity: IdentityRecord, sha256: str, name: str, licence: str, content: bytes
    ) -> ArtefactRecord:
        """Store a file, or extend the lifetime of a file that this identity stored earlier.

        Args:
            identity: its owner.
            sha256: hash that the content must have.
            name: name of the file; its suffix says what the file is.
            licence: licence of the content, as text.
            content: the file, which `check_content` has checked.

        Raises:
            ServiceError: the content exceeds a quota of the identity.
        """
        self.check_quota(identity, sha256, len(content))
        if sha256 not in self.of(identity.id):
            self._log.keep(content)
        data = {"name": name, "licence": licence, "bytes": len(content)}
        data |= {"until_s": self._until_s()}
        self._log.record("artefact.added", sha256, data, actor=identity.id, owner=identity.id)
        return self.of(identity.id)[sha256]

    def of(self, identity: str) -> Mapping[str, ArtefactRecord]:
        """Return the artefacts of an identity by hash."""
        return self._log.state.artefacts.get(identity, {})

    def content(self, identity: IdentityRecord, sha256: str) -> bytes:
        """Return a file to an owner, or to a node that hosts a session or job that needs it."""
        if sha256 not in self.of(identity.id) and not self._is_needed_by(identity.id, sha256):
            raise problem(
                "not-found", f"there is no artefact {sha256} of yours, or of a session on your node"
            )
        return self._log.content(sha256)

    def _is_needed_by(self, identity: str, sha256: str) -> bool:
        """Return whether a node of an identity hosts a session or job that needs a file."""
        nodes, known = self._log.state.nodes, self._log.state
        return any(
            one.node is not None
            and nodes[one.node].identity == identity
            and sha256 in known.files_of(one.configuration)
            and sha256 in self.of(one.owner)
            for one in known.sessions.values()
        )

    def delete(self, identity: IdentityRecord, sha256: str) -> None:
        """Delete a file of an identity; refuse if one of its open sessions or jobs needs it."""
        if sha256 not in self.of(identity.id):
            raise problem("not-found", f"there is no artefact {sha256} of yours")
        if sha256 in self._in_use(identity.id):
            raise problem(
                "conflict", f"an open session or job needs artefact {sha256}: end it first"
            )
        self._log.record("artefact.deleted", sha256, actor=identity.id, owner=identity.id)

    def use(self, identity: IdentityRecord, files: Collection[str]) -> None:
        """Extend the lifetime of files that an identity uses now.

        Raises:
            ServiceError: the identity does not have one of them.
        """
        own = self.of(identity.id)
        for sha256 in files:
            if sha256 not in own:
                raise problem("not-found", f"there is no artefact {sha256} of yours: upload it")
        until_s = self._until_s()
        for sha256 in sorted(set(files)):
            # Record the extension only after 1 % of the lifetime.
            if own[sha256].until_s < until_s - 864.0 * self._quota.days:
                data = {"until_s": until_s}
                self._log.record("artefact.used", sha256, data, owner=identity.id)

    def sweep(self) -> None:
        """Delete files whose lifetime is over and that no open session or job needs."""
        now_s = self._log.wall_s()
        for owner, files in list(self._log.state.artefacts.items()):
            old = [sha256 for sha256, one in files.items() if one.until_s < now_s]
            for sha256 in set(old) - (self._in_use(owner) if old else set()):
                self._log.record("artefact.expired", sha256, owner=owner)

    def _until_s(self) -> float:
        return self._log.wall_s() + 86_400.0 * self._quota.days

    def check_quota(self, identity: IdentityRecord, sha256: str, more: int) -> None:
        """Refuse a file of `more` bytes if it would exceed the quota of an identity."""
        own = self.of(identity.id)
        if sha256 in own:
            return
        used = sum(one.size_bytes for one in own.values())
        if len(own) >= self._quota.files:
            raise problem(
                "quota", f"you have {len(own)} of at most {self._quota.files} artefacts: delete one"
            )
        if used + more > self._quota.total_bytes:
            raise problem(
                "quota",
                f"your artefacts have {used} bytes, and {more} more exceed the limit of "
                f"{self._quota.total_bytes}: delete one",
            )

    def _in_use(self, owner: str) -> set[str]:
        """Return the hashes that open sessions and jobs of an identity need."""
        configurations = {
            one.configuration
            for one in self._log.state.sessions.values()
            if one.owner == owner and one.state not in SESSION_OVER
        }
        return {sha256 for one in configurations for sha256 in self._log.state.files_of(one)}


def check_content(name: str, sha256: str, content: bytes) -> None:
    """Check that a file has its hash, and that its content fits the suffix of its name.

    Raises:
        ServiceError: the hash differs, the suffix belongs to no kind of data, or the content is of
            another kind.
    """
    found = hashlib.sha256(content).hexdigest()
    if found != sha256:
        raise problem(
            "refused", f"the content has the SHA-256 {found}, not {sha256}: send it again"
        )
    suffix = suffix_of(name)
    try:
        _CHECKS[suffix](content)
    except (CavmarlError, ValueError, OSError, EOFError, zlib.error, expat.ExpatError) as error:
        raise problem("refused", f"{name}: is no {suffix} file ({error!s:.200})") from error


def suffix_of(name: str) -> str:
    """Return the suffix that says what a file is.

    Raises:
        ServiceError: the suffix of the name belongs to no kind of data.
    """
    for suffix in _CHECKS:
        if name.endswith(suffix):
            return suffix
    known = ", ".join(_CHECKS)
    raise problem("refused", f"{name}: must end in one of {known}; code is never an artefact")


def is_same_kind(name: str, other: str) -> bool:
    """Return whether two names have the same kind of content; raises as `suffix_of` does."""
    return _CHECKS[suffix_of(name)] is _CHECKS[suffix_of(other)]


def _check_xml(content: bytes) -> None:
    _check_elements(BytesIO(content))
    _check_root(content[:_HEAD_BYTES])


def _check_gzip(content: bytes) -> None:
    with gzip.open(BytesIO(content)) as packed:
        _check_elements(packed)
        packed.seek(0)
        _check_root(packed.read(_HEAD_BYTES))


def _check_root(head: bytes) -> None:
    """Refuse configurations of SUMO, and files whose root element is not near their beginning."""
    with tempfile.TemporaryDirectory(prefix="cavmarl-check-") as folder:
        path = Path(folder) / "file.xml"
        path.write_bytes(head)
        if is_sumo_config(path):
            raise ValueError("a configuration of SUMO only names files; upload these files instead")
        if not root_tag(path):
            raise ValueError("it has no root element")


def _check_elements(file: BinaryIO | gzip.GzipFile) -> None:
    """Check that a file is XML without a document type, and names no file outside its folder."""
    left = MOST_ELEMENTS

    def refuse_doctype(name: str, system: str | None, public: str | None, inside: int) -> None:
        raise ValueError("it declares a document type; remove its <!DOCTYPE …>")

    def check(name: str, attributes: dict[str, str]) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise ValueError(f"it has over {MOST_ELEMENTS} elements")
        for key in ("href", "file"):
            if key in attributes and not _is_inside(attributes[key]):
                raise ValueError(
                    f"<{name} {key}={attributes[key][:64]!r}> could name a file that was not "
                    "uploaded; use a path below the folder of this file"
                )

    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = refuse_doctype
    parser.StartElementHandler = check
    total = 0
    while part := file.read(1 << 20):
        total += len(part)
        if total > MOST_UNPACKED_BYTES:
            raise ValueError(f"it has over {MOST_UNPACKED_BYTES} bytes when unpacked")
        parser.Parse(part)
    parser.Parse(b"", True)


def _is_inside(path: str) -> bool:
    """Return whether a path in a file cannot lead out of the file's folder."""
    is_plain = not path.startswith(("/", "~")) and not set(path) & set("\\:$")
    return path in _NOWHERE or (is_plain and ".." not in path.split("/"))


def _check_yaml(content: bytes) -> None:
    from cavmarl.config.io import read_yaml

    if len(content) > MOST_YAML_BYTES:
        raise ValueError(f"it has {len(content)} bytes: at most {MOST_YAML_BYTES}")
    with tempfile.TemporaryDirectory(prefix="cavmarl-check-") as folder:
        path = Path(folder) / "file.yaml"
        path.write_bytes(content)
        try:
            found = read_yaml(path)
        except CavmarlError as error:
            raise ValueError(str(error).replace(str(path), "the file")) from error
    if not isinstance(found, dict):
        raise ValueError("it must be a mapping")


def _check_json(content: bytes) -> None:
    if len(content) > MOST_JSON_BYTES:
        raise ValueError(f"it has {len(content)} bytes: at most {MOST_JSON_BYTES}")
    try:
        found = json.loads(content)
    except RecursionError as error:
        raise ValueError("it is nested too deep") from error
    if not isinstance(found, dict):
        raise ValueError("it must be an object")


def _check_weights(content: bytes) -> None:
    size = int.from_bytes(content[:8], "little")
    if len(content) < 8 or size > len(content) - 8:
        raise ValueError("its header is longer than the file")
    _check_json(content[8 : 8 + size])


_CHECKS: dict[str, Callable[[bytes], Any]] = {
    ".xml": _check_xml,
    ".xml.gz": _check_gzip,
    ".osm": _check_xml,
    ".osm.gz": _check_gzip,
    ".xodr": _check_xml,
    ".yaml": _check_yaml,
    ".json": _check_json,
    ".safetensors": _check_weights,
}
