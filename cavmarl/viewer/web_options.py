"""The viewer's address, and the permissions of its pages."""

from __future__ import annotations

from dataclasses import dataclass

DEFAULT_PORT = 8710
PACKAGES = ("starlette", "uvicorn", "httptools", "websockets")  # packages of the extra `viewer`


@dataclass(frozen=True)
class WebOptions:
    """Options of one server."""

    host: str = "127.0.0.1"
    port: int = DEFAULT_PORT  # 0 picks a free port
    token: str = ""  # token of pages; not needed on the loopback address
    watch_token: str = ""  # alternative token of pages that may only watch
    control: bool = True  # whether pages may pause, step and drive
    framed: bool = False  # whether notebooks on this machine may embed the page
    send_s: float = 5.0  # time limit of a page to receive a message
