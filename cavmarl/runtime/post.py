"""How messages between a coordinator and its zones travel inside one process."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from cavmarl.ownership.messages import Message, destinations
from cavmarl.ownership.transport import Delivery

__all__ = ["DirectPost", "Post"]


class Post(Protocol):
    """Carries messages; `ownership.transport.Network` is the one that loses some of them."""

    def send(self, messages: Iterable[Message]) -> None:
        """Take messages; each goes to all of its destinations."""
        ...

    def deliver(self) -> list[Delivery]:
        """What arrives now, in order."""
        ...


class DirectPost:
    """Everything arrives once, in the order in which it was sent."""

    def __init__(self) -> None:
        self._waiting: list[Delivery] = []

    def send(self, messages: Iterable[Message]) -> None:
        """Take messages; each goes to all of its destinations."""
        for message in messages:
            for destination in destinations(message):
                self._waiting.append(Delivery(destination, message))

    def deliver(self) -> list[Delivery]:
        """What has been sent since the last time."""
        arrived, self._waiting = self._waiting, []
        return arrived
