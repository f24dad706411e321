"""How messages between a coordinator and its zones travel inside one process."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol, TypeAlias

from cavmarl.ownership.messages import Message

Parcel: TypeAlias = tuple[int, Message, bool]
"""A message at its destination, and whether it is to be refused; see `transport.Delivery`."""


class Post(Protocol):
    """Carries messages; `ownership.transport.Network` is the one that loses some of them."""

    def send(self, messages: Iterable[Message]) -> None:
        """Take messages; each goes to all of its destinations."""
        ...

    def deliver(self) -> Sequence[Parcel]: ...
