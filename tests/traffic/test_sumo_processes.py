"""SUMO's processes start and end with their worlds; if one dies, its world stays usable."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import psutil
import pytest

from cavmarl import make_vec
from cavmarl.core.errors import ConfigError, DemandError, SumoError
from cavmarl.engine.world_description import describe_world
from cavmarl.engine.world_setup import load_world
from cavmarl.traffic.sumo.sumo_input import free_libsumo
from tests.support.driving import drive, start
from tests.support.forked_processes import ForkedProcess
from tests.support.rerouting import make_map
from tests.support.sumo_worlds import MODES, alone, coupled, demand_of, tiny_file

pytest.importorskip("sumo", reason="needs the extra 'sumo'")
pytest.importorskip("libsumo", reason="needs the extra 'sumo'")

# Install the handler of Ctrl-C, because a program that a shell starts in the background ignores it.
RUN = """
import signal, sys
from cavmarl import make_vec
signal.signal(signal.SIGINT, signal.default_int_handler)
settings = {"traffic.source": sys.argv[2], "traffic.demand": [sys.argv[1]],
            "sensors.signal.timing": False}
vec = make_vec("grid4x4", num_envs=2, agents=3, background=0, overrides=settings)
vec.reset(seed=7)
for _ in range(60):
    vec.step(vec.suggest_actions())
pids = vec.worlds.simulation.sumo.worlds.pids
print(vec.state_hash(0), vec.state_hash(1), *pids, flush=True)
if sys.argv[3] == "wait":
    while True:
        vec.step(vec.suggest_actions())
"""


def settings(demand: Path, source: str) -> dict[str, object]:
    return {
        "traffic.source": source,
        "traffic.demand": [str(demand)],
        "sensors.signal.timing": False,
    }


def run(demand: Path, source: str, what: str) -> ForkedProcess:
    words = ["-c", RUN, str(demand), source, what]
    return ForkedProcess(words, stdout=subprocess.PIPE, text=True)


def answer(process: ForkedProcess) -> list[str]:
    assert process.stdout is not None
    return process.stdout.readline().split()


def all_end(pids: list[int], within_s: float = 10.0) -> bool:
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        if not any(psutil.pid_exists(pid) for pid in pids):
            return True
        time.sleep(0.05)
    return False


def test_the_memory_of_sumo_is_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    demand = tiny_file(tmp_path)
    types = "".join(f'<vType id="t{k}"/>' for k in range(100_000))  # several hundred MiB
    demand.write_text(demand.read_text().replace("</routes>", f"{types}</routes>"))
    monkeypatch.setenv("CAVMARL_MAX_SUMO_BYTES", str(32 << 20))
    overrides = settings(demand, "sumo-traffic")
    with pytest.raises(SumoError, match=r"more than 0\.03125 GiB .*MAX_SUMO_BYTES"):
        make_vec("grid4x4", num_envs=1, agents=3, background=0, overrides=overrides)


@pytest.mark.parametrize("source", MODES)
def test_two_processes_with_one_seed_have_equal_hashes(tmp_path: Path, source: str) -> None:
    """The second process is the one that runs this test."""
    demand = tiny_file(tmp_path)
    with run(demand, source, "end") as other:
        both = settings(demand, source)
        vec = make_vec("grid4x4", num_envs=2, agents=3, background=0, overrides=both)
        try:
            vec.reset(seed=7)
            for _ in range(60):
                vec.step(vec.suggest_actions())
            first = [vec.state_hash(w) for w in range(2)]
        finally:
            vec.close()
        second = answer(other)
    assert other.returncode == 0
    assert second[:2] == first
    assert first[0] != first[1], "two worlds have the same seed"
    pids = [int(pid) for pid in second[2:]]
    assert len(pids) == 2
    assert all_end(pids)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_no_process_is_left_after_ctrl_c_or_a_kill(tmp_path: Path, number: signal.Signals) -> None:
    with run(tiny_file(tmp_path), "sumo-traffic", "wait") as process:
        pids = [int(word) for word in answer(process)[2:]]
        assert len(pids) == 2
        process.send_signal(number)
    assert process.returncode != 0
    assert all_end(pids)


@pytest.mark.parametrize("source", MODES)
def test_a_world_with_a_dead_sumo_continues_after_a_reset(tmp_path: Path, source: str) -> None:
    with coupled("grid4x4", [tiny_file(tmp_path)], source, agents=3, num_worlds=2) as simulation:
        for _ in range(40):
            drive(simulation)
        assert simulation.sumo is not None
        pids = simulation.sumo.worlds.pids
        before = [simulation.state_hash(w) for w in range(2)]
        rows = [np.sort(simulation.vehicles(w), order="id") for w in range(2)]
        os.kill(pids[1], signal.SIGKILL)
        for _ in range(2):
            with pytest.raises(SumoError, match="reset"):
                drive(simulation)
            assert [simulation.state_hash(w) for w in range(2)] == before
            for w in range(2):
                assert np.sort(simulation.vehicles(w), order="id").tobytes() == rows[w].tobytes()
        start(simulation, 3)
        for _ in range(10):
            drive(simulation)
        again = [simulation.state_hash(w) for w in range(2)]
        assert simulation.sumo.worlds.pids[0] == pids[0]
    assert all_end([*pids, *simulation.sumo.worlds.pids])
    with coupled("grid4x4", [tiny_file(tmp_path)], source, seed=3, agents=3, num_worlds=2) as other:
        for _ in range(10):
            drive(other)
        assert [other.state_hash(w) for w in range(2)] == again


def resets(folder: Path, number: int) -> None:
    """Check that processes, open files and memory do not grow in a number of resets and steps."""
    with coupled("grid4x4", [tiny_file(folder)], agents=2) as simulation:
        assert simulation.sumo is not None
        (pid,) = simulation.sumo.worlds.pids
        child, here = psutil.Process(pid), psutil.Process()
        sizes, children = [], len(here.children())
        for n in range(number):
            simulation.reset()
            drive(simulation)
            assert simulation.sumo.worlds.pids == (pid,)
            if n >= 20:
                sizes.append((child.memory_info().rss, child.num_fds(), here.num_fds()))
        quarter = len(sizes) // 4
        first, last = np.median(sizes[:quarter], axis=0), np.median(sizes[-quarter:], axis=0)
        assert last[0] - first[0] < 4e6
        assert (last[1:] <= first[1:]).all()
        assert len(here.children()) == children


def test_processes_files_and_memory_do_not_grow_in_100_resets(tmp_path: Path) -> None:
    resets(tmp_path, 100)


@pytest.mark.slow
def test_processes_files_and_memory_do_not_grow_in_1000_resets(tmp_path: Path) -> None:
    resets(tmp_path, 1000)


def test_a_second_start_in_one_process_is_refused(tmp_path: Path) -> None:
    with coupled("grid4x4", [tiny_file(tmp_path)]) as simulation:
        with alone(simulation, tmp_path):
            with pytest.raises(SumoError, match="one simulation per process"):
                free_libsumo()
            drive(simulation)  # the SUMO of the world runs in another process
        free_libsumo()


def test_traci_gives_the_same_results_as_libsumo(tmp_path: Path) -> None:
    hashes = []
    for interface in ("libsumo", "traci"):
        own = {"sumo.interface": interface}
        with coupled("grid4x4", [tiny_file(tmp_path)], agents=2, overrides=own) as simulation:
            for _ in range(40):
                drive(simulation)
            hashes.append(simulation.state_hash())
            assert simulation.sumo is not None
            pids = [
                process.pid
                for pid in simulation.sumo.worlds.pids
                for process in (psutil.Process(pid), *psutil.Process(pid).children())
            ]
            assert len(pids) == (1 if interface == "libsumo" else 2)
        assert all_end(pids)
    assert hashes[0] == hashes[1]


def test_files_of_another_map_are_refused_with_sumos_message(tmp_path: Path) -> None:
    with (
        pytest.raises(
            DemandError, match=r"(?s)main_in.*Cure: give demand that was made for the map"
        ),
        coupled(make_map(tmp_path), [tiny_file(tmp_path, "merge")]),
    ):
        pass


def test_files_that_refer_to_missing_objects_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.sumocfg"
    path.write_text(
        '<configuration><input><route-files value="none.rou.xml"/></input></configuration>',
        encoding="utf-8",
    )
    with (
        pytest.raises(ConfigError, match=r"names .*none\.rou\.xml', which does not exist"),
        coupled("grid4x4", [path]),
    ):
        pass


@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        ({"traffic.demand": []}, "traffic.source"),
        ({"sensors.signal.timing": True}, "sensors.signal.timing"),
        ({"clock.sim_dt_s": 0.0125, "clock.ctrl_dt_s": 0.1}, "whole milliseconds"),
        ({"map.program": {"A0": "1"}}, "SUMO runs the signals"),
        ({"sumo.interface": "telnet"}, "sumo.interface"),
        ({"sumo.max_vehicles": 0}, "sumo.max_vehicles"),
        ({"sumo.replay_mib": -1}, "sumo.replay_mib"),
        ({"sumo.replay_mib": 0.5}, "sumo.replay_mib"),
        ({"sumo.replay_mib": "much"}, "sumo.replay_mib"),
        ({"workers.balance_steps": 8}, "workers.balance_steps"),
    ],
)
def test_invalid_arguments_are_refused(
    tmp_path: Path, wanted: dict[str, object], words: str
) -> None:
    both = settings(tiny_file(tmp_path), "sumo-traffic") | wanted
    with pytest.raises(ConfigError, match=words):
        load_world("grid4x4", overrides=both)


def test_the_version_of_sumo_is_recorded(tmp_path: Path) -> None:
    with coupled("grid4x4", [tiny_file(tmp_path)]) as simulation:
        document = describe_world(
            simulation.config, simulation.network, simulation.demand, simulation.partition
        )
        assert document["sumo"].startswith("SUMO 1.")
        assert document["demand_content_sha256"] == demand_of(simulation).content_hash


@pytest.mark.parametrize("source", MODES)
@pytest.mark.parametrize("zones", [1, 4])
def test_each_worker_has_its_own_sumo(tmp_path: Path, source: str, zones: int) -> None:
    both = settings(tiny_file(tmp_path), source)
    hashes = []
    for workers in (0, 2):
        worlds = 2 if zones == 1 else 1
        vec = make_vec(
            "grid4x4", num_envs=worlds, agents=3, background=0, zones=zones, workers=workers,
            overrides=both,
        )  # fmt: skip
        try:
            vec.reset(seed=5)
            for _ in range(40):
                vec.step(vec.suggest_actions())
            hashes.append([vec.state_hash(w) for w in range(worlds)])
        finally:
            vec.close()
    assert hashes[0] == hashes[1]


@pytest.mark.parametrize("source", MODES)
@pytest.mark.parametrize("zones", [1, 2])
def test_a_successor_of_a_dead_worker_continues(tmp_path: Path, source: str, zones: int) -> None:
    """SUMO repeats its run up to the tick. Workers also die after the repetition and a reset."""
    worlds = 2 if zones == 1 else 1
    made = {"num_envs": worlds, "agents": 3, "background": 2, "zones": zones, "max_cycles": 37,
            "overrides": settings(tiny_file(tmp_path), source)}  # fmt: skip
    plain, vec = make_vec("grid4x4", **made), make_vec("grid4x4", workers=2, **made)
    draw = np.random.default_rng(11)
    try:
        for one in (plain, vec):
            one.reset(seed=5)
        for step in range(80):
            if step in (20, 21, 36, 37, 38, 70):  # step 37 begins new episodes
                os.kill(int(draw.choice(vec.worlds.pool.pids)), signal.SIGKILL)
            results = [one.step(one.suggest_actions()) for one in (plain, vec)]
            assert results[0][0].tobytes() == results[1][0].tobytes(), step
            if step % 20 == 19:
                hashes = [[one.state_hash(w) for w in range(worlds)] for one in (plain, vec)]
                assert hashes[0] == hashes[1], step
        assert len(vec.worlds.pool.deaths) >= 6
    finally:
        plain.close()
        vec.close()


@pytest.mark.parametrize("source", MODES)
def test_a_dead_sumo_of_a_worker_is_restarted_in_the_next_step(tmp_path: Path, source: str) -> None:
    both = settings(tiny_file(tmp_path), source)
    made = {"num_envs": 2, "agents": 3, "background": 2, "overrides": both}
    plain, vec = make_vec("grid4x4", **made), make_vec("grid4x4", workers=2, **made)
    try:
        for one in (plain, vec):
            one.reset(seed=5)
            for _ in range(20):
                one.step(one.suggest_actions())
        actions = plain.suggest_actions()
        (sumo,) = psutil.Process(vec.worlds.pool.pids[1]).children()
        sumo.kill()
        with pytest.raises(SumoError, match="ended with -9"):
            vec.step(actions)
        for _ in range(10):
            actions = plain.suggest_actions()
            for one in (plain, vec):
                one.step(actions)
        assert [vec.state_hash(w) for w in range(2)] == [plain.state_hash(w) for w in range(2)]
        assert not vec.worlds.pool.deaths
    finally:
        plain.close()
        vec.close()


def test_the_death_of_a_worker_is_an_error_if_its_sumo_log_is_too_long(tmp_path: Path) -> None:
    both = settings(tiny_file(tmp_path), "sumo-traffic") | {"sumo.replay_mib": 0}
    vec = make_vec("grid4x4", num_envs=2, agents=3, background=0, workers=2, overrides=both)
    try:
        vec.reset(seed=5)
        for _ in range(20):
            actions = vec.suggest_actions()
            vec.step(actions)
        os.kill(vec.worlds.pool.pids[0], signal.SIGKILL)
        for _ in range(2):
            with pytest.raises(SumoError, match=r"(?s)exceeds 0 MiB.*reset.*sumo\.replay_mib"):
                vec.step(actions)
        vec.reset(seed=6)
        vec.step(vec.suggest_actions())
    finally:
        vec.close()


@pytest.mark.parametrize("source", MODES)
def test_a_node_continues_from_the_sumo_log_of_a_dead_node(tmp_path: Path, source: str) -> None:
    wanted = {"num_envs": 2, "agents": 3, "background": 0}
    wanted["overrides"] = settings(tiny_file(tmp_path), source)
    with (
        closing(make_vec("grid4x4", **wanted)) as one,
        closing(make_vec("grid4x4", backend="nodes:2", **wanted)) as vec,
    ):
        for each in (one, vec):
            each.reset(seed=4)
        for step in range(40):
            if step == 30:
                os.kill(vec.worlds.groups[1].pool.pids[0], signal.SIGKILL)
            actions = one.suggest_actions()
            for each in (one, vec):
                each.step(actions)
        assert [one.state_hash(w) for w in range(2)] == [vec.state_hash(w) for w in range(2)]
        assert [group.pool.losses for group in vec.worlds.groups] == [0, 1]


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="asks Linux for a process's settings")
@pytest.mark.parametrize("own", ["", "glibc.malloc.hugetlb=0"])
@pytest.mark.usefixtures("fresh_processes")
def test_the_users_settings_of_the_c_library_are_kept_and_come_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own: str
) -> None:
    monkeypatch.setenv("GLIBC_TUNABLES", own)
    vec = make_vec(
        "grid4x4", agents=1, background=0, overrides=settings(tiny_file(tmp_path), "sumo-traffic")
    )
    try:
        vec.reset(seed=7)
        simulation = vec.simulation
        assert simulation.sumo is not None
        (pid,) = simulation.sumo.worlds.pids
        environ = Path(f"/proc/{pid}/environ").read_bytes()
    finally:
        vec.close()
    # The C library replaces the colon after each setting that it has read by a zero byte.
    _, _, found = environ.replace(b":", b"\0").partition(b"GLIBC_TUNABLES=")
    words = found.decode().split("\0")
    assert words[0] == "glibc.malloc.hugetlb=1"
    assert not own or words[1] == own
