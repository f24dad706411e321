"""Queues of messages to the watchers of a world, without a server or a world."""

from __future__ import annotations

import json
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from cavmarl.viewer.frame_messages import Change, Publication
from cavmarl.viewer.page_requests import PageRequest
from cavmarl.viewer.subscribers import Audience, PageWatcher, Wishes

FIRST = (Change(1, b"whole"),)
SECOND = (*FIRST, Change(2, b"change"))


def audience() -> Audience:
    """Return an audience whose server thread is this thread."""

    def call(function: Callable[[], None]) -> None:
        function()

    found = Audience()
    loop: Any = SimpleNamespace(is_closed=lambda: False, call_soon_threadsafe=call)
    found.begin(loop)
    return found


def test_a_newer_frame_replaces_an_unsent_frame() -> None:
    watcher = PageWatcher(1)
    for number in range(3):
        watcher.offer(Publication(b"frame %d" % number, FIRST))
    assert watcher.take() == [b"whole", b"frame 2"]
    watcher.offer(Publication(b"frame 3", FIRST))
    assert watcher.take() == [b"frame 3"]
    assert watcher.take() == []


def test_each_change_of_the_roster_is_sent_once() -> None:
    watcher = PageWatcher(1)
    sent = []
    for frame, changes in ((b"1", FIRST), (b"2", FIRST), (b"3", SECOND), (b"4", SECOND)):
        watcher.offer(Publication(frame, changes))
        sent.append(watcher.take())
    assert sent == [[b"whole", b"1"], [b"2"], [b"change", b"3"], [b"4"]]
    assert watcher.take() == []


def test_a_watcher_with_more_than_256_unread_texts_is_lost() -> None:
    watcher = PageWatcher(1)
    for number in range(256):
        watcher.queue(str(number))
    assert not watcher.is_lost
    watcher.queue("256")
    assert watcher.is_lost
    assert watcher.take() == [str(number) for number in range(256)]
    assert watcher.take() == []


def test_a_late_watcher_gets_the_last_frame_and_all_events() -> None:
    here = audience()
    here.publish(Publication(b"frame", FIRST))
    here.send_events([[3, "arrived", 7, -1, ""]])
    told, whole, frame = here.join().take()
    assert json.loads(told) == {"kind": "events", "events": [[3, "arrived", 7, -1, ""]]}
    assert (whole, frame) == (b"whole", b"frame")


def test_details_go_to_the_pages_that_watch_the_vehicle() -> None:
    here = audience()
    one, other, third = (here.join() for _ in range(3))
    here.ask(one, PageRequest("watch", 7.0, sensors=True))
    here.ask(other, PageRequest("watch", 7.0))
    here.ask(third, PageRequest("ghosts", 2.0))
    assert here.wishes == Wishes(3, frozenset({7}), frozenset({7}), (2,))
    here.send_vehicle(7, {"speed": 3.5})
    here.send(third.number, {"seat": 1})
    here.send(99, {"seat": 2})
    assert [watcher.take() for watcher in (one, other, third)] == [
        ['{"speed": 3.5}'],
        ['{"speed": 3.5}'],
        ['{"seat": 1}'],
    ]
    here.ask(one, PageRequest("watch", None))
    assert here.wishes == Wishes(3, frozenset({7}), frozenset(), (2,))


def test_a_page_that_leaves_frees_its_seat_and_ends_its_requests() -> None:
    here = audience()
    watcher, stays = here.join(), here.join()
    here.ask(watcher, PageRequest("watch", 7.0))
    here.ask(watcher, PageRequest("seat", 1.0))
    here.leave(watcher)
    assert here.wishes == Wishes(watchers=1)
    assert list(here.requests())[-1] == (watcher.number, PageRequest("seat", None))
    assert list(here.requests()) == []
    here.send_all({"kind": "told"})
    assert watcher.take() == []
    assert stays.take() == ['{"kind": "told"}']


def test_requests_beyond_a_thousand_are_dropped() -> None:
    here = audience()
    watcher = here.join()
    for number in range(1003):
        here.ask(watcher, PageRequest("seek", float(number)))
    asked = list(here.requests())
    assert [request.number for _, request in asked] == [float(number) for number in range(1000)]


@pytest.mark.parametrize("closed", [None, True])
def test_without_a_server_nothing_is_sent(closed: bool | None) -> None:
    here = Audience()
    watcher = here.join()
    if closed:
        loop: Any = SimpleNamespace(is_closed=lambda: True)
        here.begin(loop)
    here.send_all({"kind": "told"})
    assert watcher.take() == []
