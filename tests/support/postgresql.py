"""A real PostgreSQL server for tests, with its own folder and port."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

__all__ = ["running_postgresql"]

DEBIAN = Path("/usr/lib/postgresql")  # the Debian package does not add the server to PATH


def find_programs() -> Path | None:
    """Return the folder of initdb, postgres and pg_ctl from PATH, or the newest one of Debian."""
    if (found := shutil.which("initdb")) and shutil.which("postgres") and shutil.which("pg_ctl"):
        return Path(found).parent
    folders = sorted(DEBIAN.glob("*/bin"), key=lambda one: float(one.parent.name))
    return folders[-1] if folders and (folders[-1] / "initdb").is_file() else None


@contextmanager
def running_postgresql() -> Iterator[str]:
    """Run a server within the block and yield its URL; skip the test if it is not installed."""
    programs = find_programs()
    if programs is None:
        pytest.skip(
            "no PostgreSQL on this machine, so stores are tested on SQLite alone; on Debian: "
            "apt-get install postgresql"
        )
    folder = Path(
        tempfile.mkdtemp(prefix="cavmarl-pg-")
    )  # unlike tmp_path, every user can reach this folder
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    user = ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups"]
    prefix = user if os.geteuid() == 0 else []  # PostgreSQL refuses to run as root
    if prefix:
        os.chown(folder, 65534, 65534)
    data = folder / "data"
    words = [str(programs / "initdb"), "-D", str(data), "-U", "postgres", "-A", "trust"]
    subprocess.run([*prefix, *words, "--no-sync"], check=True, capture_output=True)
    options = f"-p {port} -k {folder} -c listen_addresses=127.0.0.1"
    server = [*prefix, str(programs / "pg_ctl"), "-D", str(data), "-w", "-l", str(folder / "log")]
    subprocess.run([*server, "-o", options, "start"], check=True, capture_output=True)
    try:
        yield f"postgresql://postgres@127.0.0.1:{port}/postgres"
    finally:
        subprocess.run([*server, "-m", "immediate", "stop"], check=False, capture_output=True)
        shutil.rmtree(folder, ignore_errors=True)
