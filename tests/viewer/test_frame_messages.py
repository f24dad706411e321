"""Binary messages of the viewer: decoded frames and rosters equal the encoded ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cavmarl.engine.world_frame import SEEN, WorldFrame
from cavmarl.viewer.frame_messages import (
    FRAME_HEAD,
    MARGIN_M,
    REBASE_CHANGES,
    ROSTER_HEAD,
    ROSTER_ROW,
    FrameEncoder,
)

ORIGIN = np.array([100.0, -50.0])


class Page:
    """A decoder of messages that works like the page."""

    def __init__(self) -> None:
        self.roster = np.zeros(0, ROSTER_ROW)
        self.version = 0

    def take_roster(self, message: bytes) -> None:
        kind, whole, self.version, count, left = ROSTER_HEAD.unpack_from(message)
        assert kind == 2
        gone = np.frombuffer(message, "<f8", left, ROSTER_HEAD.size)
        rows = np.frombuffer(message, ROSTER_ROW, count, ROSTER_HEAD.size + 8 * left)
        kept = self.roster[:0] if whole else self.roster
        kept = kept[~np.isin(kept["id"], gone) & ~np.isin(kept["id"], rows["id"])]
        both = np.concatenate([kept, rows])
        self.roster = both[np.argsort(both["id"])]

    def take_frame(self, message: bytes) -> dict[str, np.ndarray]:
        head = FRAME_HEAD.unpack_from(message)
        version, count, signals, zones = head[3], head[7], head[8], head[9]
        assert (version, count) == (self.version, len(self.roster))
        at = FRAME_HEAD.size + 4 * signals
        ghosts = {}
        for _ in range(zones):
            zone, num = np.frombuffer(message, "<u4", 2, at).tolist()
            ghosts[zone] = self.roster["id"][np.frombuffer(message, "<u4", num, at + 8)]
            at += 8 + 4 * num
        rows = np.frombuffer(message, np.uint8, 9 * count, at).reshape(count, 3, 3)
        words = rows @ np.array([1, 256, 65536])
        return {
            "xy": words[:, :2] / 100.0 - MARGIN_M,
            "heading": (words[:, 2] & 2047) * 2.0 * np.pi / 2048.0,
            "speed": ((words[:, 2] >> 11) & 511) / 4.0,
            "flags": words[:, 2] >> 20,
            "signals": np.frombuffer(message, "<u4", signals, FRAME_HEAD.size),
            "ghosts": ghosts,
        }


def frame_with(ids: list[int], tick: int, seed: int = 0) -> WorldFrame:
    random = np.random.default_rng([seed, tick])
    rows = np.zeros(len(ids), SEEN)
    rows["id"] = sorted(ids)
    rows["x"] = ORIGIN[0] + random.uniform(-900.0, 5000.0, len(ids))
    rows["y"] = ORIGIN[1] + random.uniform(-900.0, 5000.0, len(ids))
    rows["heading"] = random.uniform(-np.pi, np.pi, len(ids))
    rows["speed"] = random.uniform(-5.0, 60.0, len(ids))
    rows["accel"] = random.uniform(-3.0, 3.0, len(ids))
    rows["blinker"] = random.integers(-1, 2, len(ids))
    rows["length"], rows["width"], rows["height"] = 4.6, 1.8, 1.5
    rows["zone"] = rows["id"] % 4
    rows["target_zone"] = -1
    rows["agent"] = -1
    return WorldFrame(0, tick, tick / 10.0, rows, np.array([3, 5], np.int32))


def check(page: Page, frame: WorldFrame, message: bytes) -> None:
    shown, rows = page.take_frame(message), frame.vehicles
    places = np.stack([rows["x"], rows["y"]], axis=1) - ORIGIN
    np.testing.assert_allclose(shown["xy"], places, rtol=0, atol=0.00501)
    turn = np.angle(np.exp(1j * (shown["heading"] - rows["heading"])))
    assert np.abs(turn).max(initial=0.0) <= np.pi / 2048 + 1e-9
    np.testing.assert_allclose(shown["speed"], np.abs(rows["speed"]), rtol=0, atol=0.1251)
    assert (shown["flags"] & 1 == (rows["accel"] < -0.8)).all()
    assert ((shown["flags"] >> 1) & 1 == (rows["blinker"] > 0)).all()
    assert ((shown["flags"] >> 2) & 1 == (rows["blinker"] < 0)).all()
    assert (page.roster["id"] == rows["id"]).all()
    assert (page.roster["zone"] == rows["zone"]).all()
    assert (page.roster["length_cm"] == 460).all()
    assert (shown["signals"] == frame.signals).all()


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.sets(st.integers(0, 40)), st.booleans(), st.booleans()), max_size=12))
def test_pages_that_join_late_or_miss_frames_get_the_same_data(
    moments: list[tuple[set[int], bool, bool]],
) -> None:
    encoder = FrameEncoder(ORIGIN)
    steady, late = Page(), Page()
    tick = 0
    for ids, anew, joins in moments:
        tick = 0 if anew else tick + 1
        frame = frame_with(list(ids), tick)
        shown = encoder.publication(frame)
        watching = [steady] + ([late] if joins else [])
        for page in watching:
            for message in shown.since(page.version):
                page.take_roster(message)
            check(page, frame, shown.frame)


def test_many_changes_are_replaced_by_a_whole_roster() -> None:
    encoder = FrameEncoder(ORIGIN)
    page = Page()
    for tick in range(3 * REBASE_CHANGES):
        frame = frame_with([*range(10), 10 + tick], tick)
        shown = encoder.publication(frame)
        assert len(shown.roster) <= REBASE_CHANGES
        if tick % 7 == 0:
            for message in shown.since(page.version):
                page.take_roster(message)
            check(page, frame, shown.frame)


def test_a_frame_of_ten_thousand_vehicles_has_at_most_100_kb() -> None:
    encoder = FrameEncoder(ORIGIN)
    encoder.publication(frame_with(list(range(10_000)), 1))
    shown = encoder.publication(frame_with(list(range(10, 10_010)), 2))
    assert len(shown.frame) + len(shown.roster[-1].message) <= 100_000


def test_messages_include_ghosts_and_transfers() -> None:
    frame = frame_with([1, 2, 3, 4], 5)
    frame.vehicles["transfer"][1] = 1
    frame.vehicles["target_zone"][1] = 3
    frame = frame._replace(ghosts=(np.array([], np.int64), np.array([2, 4]), np.array([1])))
    shown = FrameEncoder(ORIGIN).publication(frame, ghosts_of=(1, 2, 9), paused=True, pace=0.0)
    page = Page()
    page.take_roster(shown.roster[0].message)
    found = page.take_frame(shown.frame)
    assert {zone: ids.tolist() for zone, ids in found["ghosts"].items()} == {1: [2, 4], 2: [1]}
    assert page.roster["target"].tolist() == [-1, 3, -1, -1]
    assert FRAME_HEAD.unpack_from(shown.frame)[1] == 1


def test_values_beyond_the_range_are_clipped() -> None:
    frame = frame_with([1], 0)
    frame.vehicles["x"], frame.vehicles["speed"] = -1e9, 1e9
    shown = FrameEncoder(ORIGIN).publication(frame)
    page = Page()
    page.take_roster(shown.roster[0].message)
    found = page.take_frame(shown.frame)
    assert found["xy"][0, 0] == -MARGIN_M
    assert found["speed"][0] == pytest.approx(127.75)
