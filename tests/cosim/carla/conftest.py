"""Servers for CARLA's clients, in this process and on ports, and programs with the official client.

The client can abort its process, so each program that uses the client runs in its own process.
`CAVMARL_CARLA_PYTHON` names a Python with client 0.9.16; the default is the Python of the tests, if
it has the package `carla`. `CAVMARL_CARLA_PYTHON_0_9_15` (package `carla-0-9-15`) and
`CAVMARL_CARLA_PYTHON_0_10_0` name Pythons with other versions of the client. If
`CAVMARL_CARLA_VERSION` is set, all tests use the client of that version.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

import pytest

from cavmarl.config.world_spec import WorldSpec
from cavmarl.cosim.carla.call_table import Caller, answer
from cavmarl.cosim.carla.carla_server import CarlaServer
from cavmarl.cosim.carla.carla_session import CarlaSession
from cavmarl.cosim.carla.carla_versions import DEFAULT_VERSION
from cavmarl.cosim.carla.hosted_world import LoadedWorlds

Call = Callable[..., Any]
VERSION = os.environ.get("CAVMARL_CARLA_VERSION", DEFAULT_VERSION)


def make_server(
    agents: int = 3, background: int = 8, env: str = "grid4x4", **options: Any
) -> CarlaServer:
    spec = WorldSpec.of(env, agents=agents, background=background)
    return CarlaServer(LoadedWorlds(spec), port=0, **{"client": VERSION, **options})


@pytest.fixture(scope="module")
def session() -> Iterator[CarlaSession]:
    """Open a session whose world advances only when the session ticks."""
    with make_server() as server:
        yield server.session


@pytest.fixture(scope="module")
def call(session: CarlaSession) -> Call:
    """Return a function that calls the server like a client, and raises its errors."""
    caller = Caller("test")

    def send(name: str, *arguments: Any) -> Any:
        error, result = answer(caller, session, name, list(arguments))
        if error is not None:
            raise RuntimeError(error)
        match result:
            case [[False]]:
                return None
            case [[True, [message]]] | [[0, [message]]]:
                raise RuntimeError(message)
            case [[1, value]]:
                return value
        return result

    return send


@contextmanager
def running_server(**options: Any) -> Iterator[int]:
    """Run a server in a thread; yield its port."""
    over = threading.Event()
    with make_server(**options) as server:
        thread = threading.Thread(target=server.run, args=(over.is_set,), daemon=True)
        thread.start()
        try:
            yield server.port
        finally:  # the world must not be closed while the thread steps it
            over.set()
            thread.join(10.0)
        assert not thread.is_alive()


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    """The port of a server for the client."""
    with running_server() as found:
        yield found


def client_python(version: str) -> str:
    """Return a Python that has the official client; skip the test if there is none."""
    is_default = version == DEFAULT_VERSION
    name = "CAVMARL_CARLA_PYTHON" + ("" if is_default else f"_{version.replace('.', '_')}")
    found = os.environ.get(name)
    if found:
        return found
    if not is_default or find_spec("carla") is None:
        pytest.skip(
            f"CARLA's client {version} is not installed: set {name} to a Python that has it"
        )
    return sys.executable


_START = """
import json, queue, sys, time, carla
client = carla.Client("127.0.0.1", int(sys.argv[1]))
client.set_timeout(20.0)
world = client.get_world()
found = {}
"""
_END = "\nprint('FOUND' + json.dumps(found), flush=True)\n"


def run_client(port: int, program: str, version: str = VERSION) -> dict[str, Any]:
    """Run a program that uses `client` and `world`, and return the dict `found` that it fills."""
    done = subprocess.run(
        [client_python(version), "-c", _START + program + _END, str(port)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    lines = [line for line in done.stdout.splitlines() if line.startswith("FOUND")]
    assert lines, f"exit code {done.returncode}: {done.stdout}\n{done.stderr}"
    result: dict[str, Any] = json.loads(lines[0].removeprefix("FOUND"))
    return result
