"""Options of commands that serve a page, and the function that prints its address."""

from __future__ import annotations

from typing import Annotated

from rich.console import Console

from cavmarl.cli.output import (
    PAGE,
    about,
)

TOKEN_VARIABLE = "CAVMARL_VIEWER_TOKEN"

WebPort = Annotated[
    int, about("Port of the page; 0 picks a free port.", "--port", metavar="PORT", panel=PAGE)
]
WebHost = Annotated[
    str,
    about(
        "Address to serve the page on. An address that other machines can reach needs a token.",
        "--host",
        metavar="ADDRESS",
        panel=PAGE,
    ),
]
WebToken = Annotated[
    str,
    about(
        "Token that browsers must present to watch and control.",
        "--token",
        metavar="TOKEN",
        envvar=TOKEN_VARIABLE,
        panel=PAGE,
    ),
]

WatchToken = Annotated[
    str,
    about(
        "Token that allows browsers to watch only.", "--watch-token", metavar="TOKEN", panel=PAGE
    ),
]


def say(text: str) -> None:
    """Print a line without markup, highlighting or wrapping."""
    Console().print(text, markup=False, highlight=False, soft_wrap=True)
