"""AT11: a tick that every host dies of is kept in a file, from which one process runs it again."""

from __future__ import annotations

import base64
import json
import re
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl import CavVectorEnv, make_vec
from cavmarl.core.errors import (
    ConfigError,
    JournalError,
    LostTickError,
    MapError,
)
from cavmarl.handoff.fault_injection.fault_plan import Crash, Faults
from cavmarl.handoff.fault_injection.reproducer_file import SCHEMA, Reproducer, read_reproducer
from cavmarl.ownership.transport import Rates
from cavmarl.shards.shard import Shard
from cavmarl.verify.replay import changed_versions, replay_tick, world_of
from tests.support.faulted import BUSY, NOISE, Recorded, follow, record
from tests.support.rerouting import CARS, DEVICE, FLOW, make_map, rerouter, write_demand

ZONES = 4
STEPS = 12


@pytest.fixture(scope="module")
def busy() -> Recorded:
    return record("grid4x4", BUSY, STEPS)


def worlds(run: Recorded, faults: Faults | None, folder: Path) -> CavVectorEnv:
    settings = {"zones.reproducers": str(folder)}
    if faults is not None:
        settings["zones.faults"] = faults.to_json()
    return make_vec(run.env, num_envs=1, zones=ZONES, overrides=run.settings | settings)


def poisoned(run: Recorded, faults: Faults | None, folder: Path) -> Reproducer:
    """What is left of a run that ends in a tick which no host survives."""
    with pytest.raises(LostTickError, match="to run that tick again: cavmarl verify --rep") as died:
        follow(run, worlds(run, faults, folder))
    path = died.value.reproducer
    assert isinstance(path, Path)
    assert str(path) in str(died.value)
    assert list(folder.iterdir()) == [path]
    return read_reproducer(path)


@pytest.mark.parametrize("point", ["PREPARE arrives", "lease taken", "resolve", "before DONE"])
def test_the_tick_fails_as_it_did_and_without_its_faults_is_the_undivided_one(
    busy: Recorded, point: str, tmp_path: Path
) -> None:
    deaths = tuple(Crash(tick, point, 1, times=10**6) for tick in range(9, 25))
    noisy = {kind: replace(rates, corrupt=0.0) for kind, rates in NOISE.items()}
    kept = poisoned(busy, Faults(messages=noisy, crashes=deaths), tmp_path)
    assert (kept.zone, kept.episode, kept.first_world) == (1, 1, 0)
    assert kept.tick >= 9
    world = world_of(kept)
    with pytest.raises(LostTickError, match=f"zone 1 could not reach tick {kept.tick}: 4 hosts"):
        replay_tick(kept, world)
    assert len(list(tmp_path.iterdir())) == 1
    found = replay_tick(kept, world, faults=False)
    if kept.is_last:
        assert found == busy.hashes[kept.tick // 2][0]


@pytest.mark.parametrize("point", ["BEGIN torn", "STEP sent", "all done", "COMMIT torn"])
def test_a_tick_that_kills_every_coordinator_is_kept_as_well(
    busy: Recorded, point: str, tmp_path: Path
) -> None:
    deaths = (Crash(10, point, None, times=10**6),)
    kept = poisoned(busy, Faults(crashes=deaths), tmp_path)
    assert (kept.zone, kept.tick) == (None, 10)
    world = world_of(kept)
    with pytest.raises(LostTickError, match=f"could not reach tick 10: 4 .* at '{point}'"):
        replay_tick(kept, world)
    assert replay_tick(kept, world, faults=False) == busy.hashes[5][0]


class Poison:
    """Lets a zone raise on one state, wherever and however often it senses there.

    Args:
        zone: which.
        tick: of the episode, whose state it is.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, zone: int, tick: int) -> None:
        self.calls = 0
        complete = Shard.complete_observations  # the end of `sense`

        def poisoned(shard: Shard, chosen: NDArray[np.bool_]) -> None:
            complete(shard, chosen)
            if shard.zone == zone and shard.worlds.ticks[0] == tick:
                self.calls += 1
                raise ZeroDivisionError("poison")

        monkeypatch.setattr(Shard, "complete_observations", poisoned)


def test_a_state_that_the_code_breaks_on_is_found_again(
    busy: Recorded, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    poison = Poison(monkeypatch, zone=2, tick=14)
    kept = poisoned(busy, None, tmp_path)
    assert (kept.zone, kept.tick, kept.is_first, kept.is_last) == (2, 14, False, True)
    assert "the last one at 'sense', of ZeroDivisionError('poison')" in kept.cause
    assert poison.calls == 4
    world = world_of(kept)
    for path in tmp_path.iterdir():  # the folder is another machine's
        path.unlink()
    tmp_path.rmdir()
    with pytest.raises(LostTickError, match="tick 14: 4 hosts in a row"):
        replay_tick(kept, world)
    with pytest.raises(ZeroDivisionError):
        replay_tick(kept, world, faults=False)
    monkeypatch.undo()
    assert replay_tick(kept, world) == busy.hashes[7][0]


def test_without_the_folder_an_exception_of_a_zone_is_what_it_is(
    busy: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    poison = Poison(monkeypatch, zone=2, tick=14)
    with pytest.raises(ZeroDivisionError):
        follow(busy, make_vec(busy.env, num_envs=1, zones=ZONES, overrides=busy.settings))
    assert poison.calls == 1


def test_an_undivided_world_has_one_host(
    busy: Recorded, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    Poison(monkeypatch, zone=0, tick=14)
    settings = {"zones.reproducers": str(tmp_path)}
    whole = make_vec(busy.env, num_envs=1, overrides=busy.settings | settings)
    with pytest.raises(LostTickError, match="zone 0 could not reach tick 14") as died:
        follow(busy, whole)
    monkeypatch.undo()
    assert isinstance(died.value.reproducer, Path)
    kept = read_reproducer(died.value.reproducer)
    assert replay_tick(kept, world_of(kept)) == busy.hashes[7][0]


def test_one_world_at_a_time_is_kept(busy: Recorded, tmp_path: Path) -> None:
    settings = {"zones.reproducers": str(tmp_path)}
    with pytest.raises(ConfigError, match=r"zones\.reproducers: hosts die in one world at a time"):
        make_vec(busy.env, num_envs=2, zones=ZONES, overrides=busy.settings | settings)


def test_a_later_episode_of_a_long_run_is_found_again(
    busy: Recorded, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    deaths = (*(Crash(tick, "advance", tick % ZONES) for tick in range(2, 40, 5)),
              Crash(41, "resolve", 3, times=4))  # fmt: skip
    vec = worlds(busy, Faults(crashes=deaths), tmp_path)
    follow(busy, vec)
    vec.reset()
    for actions in busy.actions[:8]:
        vec.step(actions)
    with pytest.raises(LostTickError) as died:
        vec.step(busy.actions[8])
    path = died.value.reproducer
    assert isinstance(path, Path)
    kept = read_reproducer(path)
    assert (kept.episode, kept.tick, kept.records[-1].tick) == (2, 41, 41)
    assert kept.records[-1].episode == 1
    whole = make_vec(busy.env, num_envs=1, overrides={
        key: value for key, value in busy.settings.items() if not key.startswith("zones.")
    })  # fmt: skip
    whole.reset(seed=busy.seed)
    whole.reset()
    for actions in busy.actions[:9]:
        whole.step(actions)
    assert kept.is_first
    kept = replace(kept, is_last=True)
    told = busy.settings | {"zones.faults": Faults().to_json()}
    simulation = make_vec(busy.env, num_envs=1, zones=ZONES, overrides=told).simulation
    simulation.resume(kept)
    simulation.run_tick(kept.commands, True, False)
    simulation.run_tick(kept.commands, False, True)
    assert simulation.state_hash() == whole.state_hash()


def test_vehicles_that_look_for_their_way_are_found_again(tmp_path: Path) -> None:
    net = make_map(tmp_path)
    files = write_demand(
        tmp_path, CARS.format(device=DEVICE) + FLOW, rerouter('<closingReroute id="narrow"/>')
    )
    settings = {
        "clock.sim_dt_s": 0.2, "clock.ctrl_dt_s": 1.0, "horizon_s": 1200.0,
        "population.agents": 1, "traffic.demand": [str(file) for file in files],
    }  # fmt: skip
    folder = tmp_path / "kept"
    folder.mkdir()
    run = record(net, settings, 60)
    kept = poisoned(run, Faults(crashes=(Crash(300, "leave", 1, times=4),)), folder)
    assert kept.sources["demand"]
    with pytest.raises(MapError, match="no file"):
        world_of(kept, "grid4x4")
    with pytest.raises(JournalError, match=r"the demand .* name the environment that has it"):
        world_of(replace(kept, sources=dict(kept.sources) | {"demand": "00"}), net)
    assert replay_tick(kept, world_of(kept, net), faults=False) == run.hashes[60][0]


def test_a_folder_that_cannot_be_written_is_named_in_the_error(
    busy: Recorded, tmp_path: Path
) -> None:
    faults = Faults(messages={"Ack": Rates(drop=0.5)}, crashes=(Crash(5, "resolve", 1, times=4),))
    folder = tmp_path / "kept"
    with pytest.raises(ConfigError, match=r"zones\.reproducers = '.*kept': no such folder"):
        worlds(busy, faults, folder)
    folder.mkdir()
    vec = worlds(busy, faults, folder)
    folder.rmdir()
    with pytest.raises(LostTickError, match=r"cannot be run again: .* cannot be written \(No such"):
        follow(busy, vec)


@pytest.fixture(scope="module")
def written(busy: Recorded, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kept")
    poisoned(busy, Faults(crashes=(Crash(5, "resolve", 1, times=4),)), folder)
    (path,) = folder.iterdir()
    return path


def test_a_file_is_the_same_when_it_is_read_and_written(written: Path, tmp_path: Path) -> None:
    kept = read_reproducer(written)
    kept.write(tmp_path / "again.json")
    assert (tmp_path / "again.json").read_text() == written.read_text()
    assert changed_versions(kept) == []
    assert changed_versions(replace(kept, made_with=dict(kept.made_with) | {"numba": "0.1"}))


def resealed(content: dict[str, Any], path: Path) -> Path:
    """A file whose checksum is right whatever stands in it."""
    from cavmarl.handoff.fault_injection import reproducer_file as reproducer

    body = reproducer._json({key: value for key, value in content.items() if key != "checksum"})
    path.write_text(f'{body[:-1]},"checksum":"{reproducer._checksum(body)}"}}\n')
    return path


@pytest.mark.parametrize("place", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_damaged_file_is_refused(written: Path, place: float, tmp_path: Path) -> None:
    content = bytearray(written.read_bytes())
    content[int(place * len(content))] ^= 0x04
    path = tmp_path / "damaged.json"
    path.write_bytes(bytes(content))
    with pytest.raises(JournalError, match=r"damaged|schema"):
        read_reproducer(path)
    path.write_bytes(written.read_bytes()[: int(place * len(content))])
    with pytest.raises(JournalError, match="damaged"):
        read_reproducer(path)


def test_what_is_no_reproducer_is_refused(written: Path, tmp_path: Path) -> None:
    with pytest.raises(JournalError, match="cannot be read"):
        read_reproducer(tmp_path / "nowhere.json")
    content = json.loads(written.read_text())
    text = base64.b64encode(zlib.compress(bytes(8))).decode()
    for change in (
        {"schema": "cavmarl.reproducer/2"},
        {"commands": [{"dtype": "<f8", "shape": [3], "data": text}]},
        {"commands": [{"dtype": "<f8", "shape": [1], "data": "AAAA"}]},
        {"commands": [{"dtype": "|O", "shape": [1], "data": text}]},
        {"records": [{}]},
        {"image": None},
        {"more": 1},
    ):
        path = resealed(content | change, tmp_path / "other.json")
        with pytest.raises(
            JournalError, match=re.escape(SCHEMA) if "schema" in change else "written by"
        ):
            read_reproducer(path)


def test_rows_of_another_layout_are_refused(written: Path, tmp_path: Path) -> None:
    content = json.loads(written.read_text())
    (name, *_), *_ = content["image"]["rows"][0]["dtype"]
    for entry in content["image"]["rows"]:
        entry["dtype"][0][0] = f"{name}_of_old"
    kept = read_reproducer(resealed(content, tmp_path / "old.json"))
    with pytest.raises(JournalError, match="another layout"):
        replay_tick(kept, world_of(kept), faults=False)
