"""Collect errors of calls in a fork of this process."""

from __future__ import annotations

import os
from collections.abc import Callable

from cavmarl.core.errors import CavmarlError


def said_in_fork(*calls: Callable[[], object]) -> str:
    """Make calls in a fork that ends without cleanup; return the messages of the raised errors."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            for call in calls:
                try:
                    call()
                except CavmarlError as error:
                    os.write(writing, f"{type(error).__name__}: {error}\n".encode())
        finally:
            os._exit(0)
    os.close(writing)
    os.waitpid(child, 0)
    with os.fdopen(reading, encoding="utf-8") as pipe:
        return pipe.read()
