"""`Reception` accepts followers while a world runs, without waiting for any of them."""

from __future__ import annotations

import selectors
import time
from collections.abc import Iterator
from contextlib import suppress
from hmac import compare_digest

from cavmarl.core.errors import ConfigError, FollowerError
from cavmarl.cosim.followers.follower_connection import Address, FollowerConnection, listen
from cavmarl.cosim.followers.follower_messages import (
    MAX_VEHICLES,
    FollowerRefusal,
    Hello,
    Say,
    read_letter,
)

GREETING_S = 5.0  # for a caller to introduce itself
HEARING_S = 1.0  # for what has begun to arrive
MAX_GUESTS = 64  # not introduced yet
GOES_ON = (
    "the world is whole and can be stepped on, with the built-in driver in its place or another "
    "follower"
)


class Reception:
    """Listens at an address.

    Args:
        address: path of a Unix socket, or a port of this machine.
        secret: that callers have to say; empty: none.

    Attributes:
        address: where it listens; the port that was found, where any would do.
        turned_away: how many callers were not understood, or said nothing.

    Raises:
        ConfigError: the socket cannot be opened.
    """

    def __init__(self, address: Address, secret: str = "") -> None:
        if isinstance(address, int) and not secret:
            raise ConfigError(
                f"address = {address}: every user of this machine can call a port; give a secret "
                "(cavmarl lead --secret-file), or the path of a Unix socket"
            )
        self._secret = secret.encode()
        self._listener = listen(address)
        self._listener.setblocking(False)
        name = self._listener.getsockname()
        self.address: Address = name[1] if isinstance(name, tuple) else name
        self.turned_away = 0
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._since: dict[FollowerConnection, float] = {}

    def callers(self, within_s: float = 0.0) -> Iterator[tuple[FollowerConnection, Hello]]:
        """Followers that have introduced themselves since the last call, in order.

        Args:
            within_s: how long to wait for the first; 0: not at all.
        """
        heard = self._selector.select(within_s)
        for key, _ in sorted(heard, key=lambda found: found[0].fd):
            if key.fileobj is self._listener:
                self._open()
                continue
            line = key.data
            self._forget(line)
            try:
                yield line, self._greeting(line)
            except FollowerError as error:
                self.turn_away(line, str(error))
        self._dismiss_the_silent()

    def turn_away(self, line: FollowerConnection, reason: str) -> None:
        self.turned_away += 1
        refuse(line, reason)

    def close(self) -> None:
        """Listen no more; a Unix socket's path is removed."""
        for line in list(self._since):
            self._forget(line)
            line.close()
        self._selector.close()
        self._listener.close()

    def _open(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:  # it is gone already
            return
        line = FollowerConnection(connection, "a caller", GOES_ON)
        if len(self._since) == MAX_GUESTS:
            self.turn_away(line, "too many callers have not introduced themselves")
            return
        self._since[line] = time.monotonic()
        self._selector.register(line, selectors.EVENT_READ, line)

    def _greeting(self, line: FollowerConnection) -> Hello:
        heard = line.hear(HEARING_S)
        if heard.kind is not Say.HELLO:
            raise FollowerError(f"a caller begins with {heard.kind.name}: HELLO comes first")
        line.skip(heard)
        hello = read_letter(Hello, heard.letter)
        if self._secret and not compare_digest(hello.secret.encode(), self._secret):
            raise FollowerError("a caller does not know the secret of this world")
        if not hello.name.isprintable():
            raise FollowerError("a caller's name has characters that cannot be printed")
        if len(hello.vehicles) > MAX_VEHICLES:
            raise FollowerError(f"a caller wants {len(hello.vehicles)} vehicles")
        line.name = f"follower '{hello.name[:80]}'"
        return hello

    def _dismiss_the_silent(self) -> None:
        for line, since in list(self._since.items()):
            if time.monotonic() - since > GREETING_S:
                self._forget(line)
                self.turn_away(line, f"said nothing within {GREETING_S:g} s")

    def _forget(self, line: FollowerConnection) -> None:
        del self._since[line]
        self._selector.unregister(line)


def refuse(line: FollowerConnection, reason: str) -> None:
    """Tell a follower why it is not gone on with, if it still listens, and hang up."""
    with suppress(FollowerError):
        line.say(Say.REFUSAL, FollowerRefusal(reason), within_s=HEARING_S)
    line.close()
