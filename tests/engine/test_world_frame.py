"""Frames of a world do not depend on its zones or its backend."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest

from cavmarl import make_vec, parallel_env
from cavmarl.core.errors import ConfigError, EpisodeError
from cavmarl.core.records.codes import EVENT_ARRIVED, EVENT_COLLIDED
from cavmarl.engine.world_frame import ENDED, SEEN, WorldFrame, events_between

_ZONE_FIELDS = ("zone", "target_zone", "transfer")
_OTHER_FIELDS = [name for name in SEEN.names or () if name not in _ZONE_FIELDS]


def _frames(zones: int, workers: int, steps: int = 25) -> list[WorldFrame]:
    with closing(make_vec("grid4x4", num_envs=1, zones=zones, workers=workers)) as vec:
        vec.reset(seed=3)
        actions = np.zeros(vec.action_space.shape, dtype=np.float32)
        frames = []
        for _ in range(steps):
            vec.step(actions)
            frames += vec.world_frames()
    return frames


@pytest.mark.parametrize(("zones", "workers"), [(4, 0), (4, 2), (1, 1)])
def test_frames_of_divided_worlds_equal_those_of_the_undivided_world(
    zones: int, workers: int
) -> None:
    for whole, divided in zip(_frames(1, 0), _frames(zones, workers), strict=True):
        assert (whole.tick, whole.time_s) == (divided.tick, divided.time_s)
        np.testing.assert_array_equal(
            whole.vehicles[_OTHER_FIELDS], divided.vehicles[_OTHER_FIELDS]
        )
        np.testing.assert_array_equal(whole.signals, divided.signals)
        np.testing.assert_array_equal(whole.ended, divided.ended)
        if zones > 1:
            assert len(set(divided.vehicles["zone"])) > 1


@pytest.mark.parametrize("workers", [0, 2])
def test_vehicles_in_transfer_have_their_target_zone(workers: int) -> None:
    num_moving = 0
    for frame in _frames(4, workers):
        targets = {transfer.vehicle: transfer.target for transfer in frame.transfers}
        moving = frame.vehicles[frame.vehicles["transfer"] != 0]
        assert dict(zip(moving["id"], moving["target_zone"], strict=True)) == targets
        assert (frame.vehicles["target_zone"][frame.vehicles["transfer"] == 0] == -1).all()
        num_moving += len(moving)
    assert num_moving


def test_a_frame_is_a_copy_of_the_state_of_the_world() -> None:
    world = parallel_env("grid4x4", zones=4)
    world.reset(seed=1)
    for _ in range(10):
        world.step({agent: world.action_space(agent).sample() for agent in world.agents})
    (frame,) = world.world_frames(ghosts=True)
    simulation = world.worlds.simulation
    rows = np.sort(simulation.vehicles(), order="id")
    for name in SEEN.names or ():
        if name in ("target_zone", "transfer"):
            continue
        derived = {"zone": rows["owner"], "vclass": simulation.types["vclass"][rows["vtype"]]}
        expected = derived[name] if name in derived else rows[name]
        np.testing.assert_array_equal(frame.vehicles[name], expected.astype(SEEN[name]))
    assert len(frame.ghosts) == 4
    assert any(len(ids) for ids in frame.ghosts)
    kept = frame.vehicles.copy()
    world.step({agent: world.action_space(agent).sample() for agent in world.agents})
    np.testing.assert_array_equal(frame.vehicles, kept)


def test_events_agree_with_the_infos_of_ended_trips() -> None:
    world = parallel_env("ring")
    world.reset(seed=1)
    (before,) = world.world_frames()
    reported: list[tuple[str, int]] = []
    ended: list[tuple[str, int]] = []
    rng = np.random.default_rng(0)
    for _ in range(150):
        if not world.agents:
            break
        low, high = -1.0, 1.0
        actions = {agent: rng.uniform(low, high, 2).astype("f4") for agent in world.agents}
        _, _, terminations, _, infos = world.step(actions)
        (after,) = world.world_frames()
        reported += [
            (event.kind, event.agent)
            for event in events_between(before, after)
            if event.agent >= 0 and event.kind in ("collision", "off_road", "arrived")
        ]
        for agent in (name for name, over in terminations.items() if over):
            terms = infos[agent]
            ended += [
                (kind, world.possible_agents.index(agent))
                for kind, term in (
                    ("collision", "collision"),
                    ("off_road", "off_road"),
                    ("arrived", "arrival"),
                )
                if terms[term]
            ]
        before = after
    assert sorted(reported) == sorted(ended)
    assert reported


def _frame(
    tick: int, rows: list[dict[str, int]], ended: list[tuple[int, int]], **named: int
) -> WorldFrame:
    vehicles = np.zeros(len(rows), dtype=SEEN)
    vehicles["agent"] = -1
    for row, values in zip(vehicles, rows, strict=True):
        for name, value in values.items():
            row[name] = value
    signals = np.array([named.get("phase", 0)], dtype=np.int32)
    return WorldFrame(0, tick, tick * 0.1, vehicles, signals, ended=np.array(ended, dtype=ENDED))


def test_events_are_derived_from_two_frames() -> None:
    before = _frame(4, [{"id": 1}, {"id": 2, "agent": 0}, {"id": 3}, {"id": 4, "zone": 1}], [])
    after = _frame(
        5,
        [{"id": 1, "events": EVENT_COLLIDED}, {"id": 4, "zone": 2}, {"id": 9}],
        [(0, EVENT_ARRIVED)],
        phase=3,
    )
    assert [tuple(event) for event in events_between(before, after)] == [
        (5, "departed", 9, -1, ""),
        (5, "arrived", 2, 0, ""),
        (5, "left", 3, -1, ""),
        (5, "collision", 1, -1, ""),
        (5, "transferred", 4, -1, "1 to 2"),
        (5, "signal", -1, -1, "0: phase 3"),
    ]


def test_unavailable_frames_are_refused() -> None:
    world = parallel_env("ring")
    with pytest.raises(EpisodeError, match="reset"):
        world.world_frames()
    world.reset(seed=0)
    with pytest.raises(ConfigError, match="must be from 0 to 0"):
        world.world_frames([1])
