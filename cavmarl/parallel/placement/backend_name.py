"""`BackendName`: where worlds run, read from the argument `backend` and its short forms."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np

from cavmarl.core.errors import ConfigError
from cavmarl.core.extensions import HOW
from cavmarl.parallel.network.mpi_transport import MPI

LOCAL, PROCESSES, NODES, RAY = "local", "processes", "nodes", "ray"
OWN = (LOCAL, PROCESSES, NODES, RAY)
FORMS = "'local', 'processes:N', 'nodes:N', 'nodes:N@HOST:PORT', 'nodes:N@mpi', 'ray:N', 'ray'"

Address = tuple[str, int]


@dataclass(frozen=True)
class BackendName:
    """Where worlds run.

    Attributes:
        kind: one of `OWN`, or the name of a registered backend.
        count: number of processes or nodes; None: no number given (`ray`: as many as are useful).
        address: host and port to listen on for nodes started by hand, or MPI, whose other ranks are
            the nodes.
    """

    kind: str = LOCAL
    count: int | None = None
    address: Address | Literal["mpi"] | None = None

    def __str__(self) -> str:
        count = "" if self.count is None else f":{self.count}"
        if self.address is None:
            return f"{self.kind}{count}"
        where = MPI if self.address == MPI else "{}:{}".format(*self.address)
        return f"{self.kind}{count}@{where}"

    @property
    def is_local(self) -> bool:
        """True if the worlds run in the process of the caller."""
        return self.kind == LOCAL

    @property
    def logs_transfers(self) -> bool:
        """True if the worlds log changes of the zone that owns a vehicle."""
        return self.kind in (LOCAL, NODES, RAY)

    @property
    def is_mpi(self) -> bool:
        """True if the nodes are the other ranks of an MPI run."""
        return self.address == MPI

    def is_split(self, num_worlds: int) -> bool:
        """Return whether processes or nodes outnumber the worlds, and so share their zones."""
        return self.count is not None and self.count > num_worlds


def read_backend(
    backend: str | None,
    workers: int | None = None,
    nodes: int | None = None,
    registered: Collection[str] = (),
) -> BackendName:
    """Return the backend that the arguments name; they have to agree.

    Args:
        backend: one of `FORMS`; None: the backend of the short form, or else `local`.
        workers: short form: N for `processes:N`, 0 for `local`.
        nodes: short form: N for `nodes:N`.
        registered: names of registered backends.

    Raises:
        ConfigError: there is no such backend, or the arguments name different backends.
    """
    given: dict[str, tuple[object, BackendName]] = {}
    if workers is not None:
        number = _number("workers", workers, 0)
        given["workers"] = workers, BackendName(PROCESSES, number) if number else BackendName()
    if nodes is not None:
        given["nodes"] = nodes, BackendName(NODES, _number("nodes", nodes, 1))
    if backend is not None:
        given["backend"] = backend, _read(backend, registered)
    for (short, (value, one)), (other, (other_value, another)) in combinations(given.items(), 2):
        if one != another:
            raise ConfigError(
                f"{short} = {value!r} with {other} = {other_value!r}: {short} = {value!r} is short "
                f"for backend = '{one}'; leave out {short}, or {other}"
            )
    return next((name for _, name in given.values()), BackendName())


def _read(backend: str, registered: Collection[str]) -> BackendName:
    if not isinstance(backend, str):
        raise ConfigError(f"backend = {backend!r}: must be a string, one of {FORMS}")
    kind, colon, rest = backend.partition(":")
    count, at, where = rest.partition("@")
    if kind not in OWN and kind not in registered:
        names = FORMS + "".join(f", '{name}'" for name in sorted(registered))
        raise ConfigError(
            f"backend = {backend!r}: there is no backend {kind!r}; use one of {names}. If a module "
            f"registers it with cavmarl.register_backend, {HOW}"
        )
    if kind == LOCAL and colon:
        raise ConfigError(f"backend = {backend!r}: 'local' has no number; use 'local'")
    if kind in (PROCESSES, NODES) and not colon:
        raise ConfigError(f"backend = {backend!r}: the number is missing; use '{kind}:2' for two")
    if colon and not (count.isascii() and count.isdigit() and int(count) > 0):
        raise ConfigError(
            f"backend = {backend!r}: the number {count!r} must be 1 or more; use '{kind}:2' for two"
        )
    if at and kind != NODES:
        raise ConfigError(
            f"backend = {backend!r}: only nodes are started by hand; use '{kind}:{count}', or "
            f"'{NODES}:{count}@{where}'"
        )
    number = int(count) if colon else None
    if not at:
        return BackendName(kind, number)
    return BackendName(kind, number, MPI if where == MPI else read_address(where))


def read_address(text: str) -> Address:
    """Read HOST:PORT. Raises ConfigError: the text has another form."""
    host, colon, port = text.rpartition(":")
    if not (host and colon and port.isascii() and port.isdigit() and 0 < int(port) < 1 << 16):
        raise ConfigError(f"{text!r}: must be HOST:PORT, like 192.168.1.10:7600")
    return host, int(port)


def _number(name: str, value: object, least: int) -> int:
    if isinstance(value, str):
        raise ConfigError(
            f"{name} = {value!r}: must be a whole number; use backend={value!r} for a backend"
        )
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise ConfigError(f"{name} = {value!r}: must be a whole number")
    if value < least:
        cure = "leave it out to run in this process" if least else "use 0 to run in this process"
        raise ConfigError(f"{name} = {value}: must be a number from {least}; {cure}")
    return int(value)
