"""What commands with a page share: its options, and how its address is told."""

from __future__ import annotations

from typing import Annotated

from rich.console import Console

from cavmarl.cli.output import about

TOKEN_VARIABLE = "CAVMARL_VIEWER_TOKEN"

WebPort = Annotated[int, about("Of the page; 0: any that is free.", "--port")]
WebHost = Annotated[
    str, about("Address of the page; others than this machine's need a token.", "--host")
]
WebToken = Annotated[str, about("Token that a page has to give.", "--token", envvar=TOKEN_VARIABLE)]

WatchToken = Annotated[str, about("Token of pages that may only watch.", "--watch-token")]


def say(text: str) -> None:
    """Print a line as it is, an address among them."""
    Console().print(text, markup=False, highlight=False, soft_wrap=True)
