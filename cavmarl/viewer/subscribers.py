"""Connects a world with its watchers: the world's thread publishes, the server's thread sends.

The world never waits. Each watcher has a buffer of one frame, which a newer frame replaces, so a
slow watcher gets fewer frames. Roster changes and texts must not be missed; they are queued up to a
limit, beyond which the watcher is dropped.
"""

from __future__ import annotations

import asyncio
import json
import queue
import threading
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ParamSpec

from cavmarl.viewer.frame_messages import Publication
from cavmarl.viewer.page_requests import PageRequest

P = ParamSpec("P")

MAX_TEXTS = 256  # maximum number of texts queued for one watcher
MAX_REQUESTS = 1000  # maximum number of requests queued for the world


@dataclass(eq=False)
class PageWatcher:
    """One open page; used by the server's thread only."""

    number: int
    has_version: int = 0  # version of the roster
    newest: Publication | None = None  # newest frame, if it is not sent yet
    texts: deque[str] = field(default_factory=deque)
    news: asyncio.Event = field(default_factory=asyncio.Event)
    vehicle: int | None = None  # id of the watched vehicle
    sensors: bool = False  # whether to include its sensors
    ghosts_of: int | None = None  # zone whose ghosts are marked
    is_lost: bool = False  # whether the page reads too slowly

    def offer(self, publication: Publication) -> None:
        self.newest = publication
        self.news.set()

    def queue(self, text: str) -> None:
        if len(self.texts) >= MAX_TEXTS:
            self.is_lost = True
        else:
            self.texts.append(text)
        self.news.set()

    def take(self) -> list[str | bytes]:
        """Return all messages to send now, in order."""
        messages: list[str | bytes] = list(self.texts)
        self.texts.clear()
        publication, self.newest = self.newest, None
        if publication is not None:
            messages += publication.since(self.has_version)
            messages.append(publication.frame)
            self.has_version = publication.version
        self.news.clear()
        return messages


@dataclass(frozen=True)
class Wishes:
    """The combined requests of all watchers."""

    watchers: int = 0
    vehicles: frozenset[int] = frozenset()
    sensed: frozenset[int] = frozenset()  # vehicles whose sensors are included
    ghosts_of: tuple[int, ...] = ()  # zones whose ghosts are marked


class Audience:
    """The watchers of one world.

    Args:
        beside: audience of another world that the same thread runs; `wait` of either audience
            returns if a page of any of these worlds sends a request.

    Attributes:
        wishes: replaced as a whole, so that the world's thread may read it at any time.
        dropped: number of watchers that read too slowly.
    """

    def __init__(self, beside: Audience | None = None) -> None:
        self.wishes = Wishes()
        self.dropped = 0
        self._watchers: dict[int, PageWatcher] = {}
        self._numbers = 0
        self._requests: queue.Queue[tuple[int, PageRequest]] = queue.Queue(MAX_REQUESTS)
        self._asked: threading.Event = threading.Event() if beside is None else beside._asked
        self._loop: asyncio.AbstractEventLoop | None = None
        self._last: Publication | None = None
        self._events: deque[list[Any]] = deque(maxlen=500)

    # Called by the world's thread.

    def publish(self, publication: Publication) -> None:
        """Offer a frame to all watchers."""
        self._call(self._spread, publication)

    def send_events(self, events: list[list[Any]]) -> None:
        """Add events to the time line: tick, kind, vehicle and details of each."""
        self._call(self._add_events, events)

    def send_all(self, content: dict[str, Any]) -> None:
        self._call(self._put_all, json.dumps(content, allow_nan=False))

    def send_vehicle(self, vehicle: int, content: dict[str, Any]) -> None:
        """Send the details of a vehicle to the pages that watch it."""
        self._call(self._put_vehicle, vehicle, json.dumps(content, allow_nan=False))

    def send(self, number: int, content: dict[str, Any]) -> None:
        self._call(self._put_one, number, json.dumps(content, allow_nan=False))

    def requests(self) -> Iterable[tuple[int, PageRequest]]:
        """Yield the requests since the last call: the watcher's number and its request."""
        while True:
            try:
                yield self._requests.get_nowait()
            except queue.Empty:
                return

    def wait(self, seconds: float) -> None:
        """Wait for a time, or until a page sends a request."""
        self._asked.wait(seconds)
        self._asked.clear()

    # Called by the server's thread.

    def begin(self, loop: asyncio.AbstractEventLoop) -> None:
        """Set the event loop that serves the watchers."""
        self._loop = loop

    def join(self) -> PageWatcher:
        self._numbers += 1
        watcher = PageWatcher(self._numbers)
        self._watchers[watcher.number] = watcher
        if self._last is not None:
            watcher.offer(self._last)
        if self._events:
            watcher.queue(_events_text(list(self._events)))
        self._update()
        self._asked.set()
        return watcher

    def leave(self, watcher: PageWatcher) -> None:
        self._watchers.pop(watcher.number, None)
        self._update()
        self.ask(watcher, PageRequest("seat"))  # free its seat

    def ask(self, watcher: PageWatcher, request: PageRequest) -> None:
        """Queue a request of a page; requests beyond MAX_REQUESTS are dropped."""
        if request.kind in ("watch", "ghosts"):
            number = None if request.number is None else int(request.number)
            if request.kind == "watch":
                watcher.vehicle, watcher.sensors = number, request.sensors
            else:
                watcher.ghosts_of = number
            self._update()
        try:
            self._requests.put_nowait((watcher.number, request))
        except queue.Full:
            return
        self._asked.set()

    def _update(self) -> None:
        watchers = self._watchers.values()
        watched = [(one.vehicle, one.sensors) for one in watchers if one.vehicle is not None]
        vehicles = frozenset(vehicle for vehicle, _ in watched)
        sensed = frozenset(vehicle for vehicle, sensors in watched if sensors)
        zones = {one.ghosts_of for one in watchers if one.ghosts_of is not None}
        self.wishes = Wishes(len(self._watchers), vehicles, sensed, tuple(sorted(zones)))

    def _call(self, function: Callable[P, None], *given: P.args, **named: P.kwargs) -> None:
        loop = self._loop
        if loop is None or loop.is_closed():
            return
        try:
            loop.call_soon_threadsafe(partial(function, *given, **named))
        except RuntimeError:  # the loop has been closed
            return

    def _spread(self, publication: Publication) -> None:
        self._last = publication
        for watcher in self._watchers.values():
            watcher.offer(publication)

    def _add_events(self, events: list[list[Any]]) -> None:
        self._events.extend(events)
        self._put_all(_events_text(events))

    def _put_all(self, text: str) -> None:
        for watcher in self._watchers.values():
            watcher.queue(text)

    def _put_vehicle(self, vehicle: int, text: str) -> None:
        for watcher in self._watchers.values():
            if watcher.vehicle == vehicle:
                watcher.queue(text)

    def _put_one(self, number: int, text: str) -> None:
        if number in self._watchers:
            self._watchers[number].queue(text)


def _events_text(events: list[list[Any]]) -> str:
    return json.dumps({"kind": "events", "events": events})
