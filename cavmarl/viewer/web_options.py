"""Where the viewer listens and what its pages may do."""

from __future__ import annotations

from dataclasses import dataclass

DEFAULT_PORT = 8710


@dataclass(frozen=True)
class WebOptions:
    """Of one server."""

    host: str = "127.0.0.1"
    port: int = DEFAULT_PORT  # 0: any that is free
    token: str = ""  # that a page has to give; the loopback address needs none
    watch_token: str = ""  # with which a page only watches, in the place of the token
    control: bool = True  # pages may pause, step and drive
    framed: bool = False  # notebooks of this machine may show the page within theirs
    send_s: float = 5.0  # in which a page has to take a message
