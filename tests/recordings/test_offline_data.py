"""Recorded trips as offline data: observation, action, reward and end of each decision."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl import ConfigError, RecordingError, RecordOptions, load_policy, make_vec, parallel_env
from cavmarl.cli import main
from cavmarl.evaluate import evaluate
from cavmarl.evaluate.evaluation import load_tables
from cavmarl.recordings.minari_export import write_minari
from cavmarl.recordings.offline_data import RecordedTrip, recorded_trips
from cavmarl.recordings.recording import Recording

pytestmark = pytest.mark.integration  # the manifest calls git

Step = tuple[bytes, bytes, float, bool, bool, bytes]


def options(path: Path) -> RecordOptions:
    return RecordOptions(path, ("observations",))


def steps_of(trips: Iterator[RecordedTrip]) -> Mapping[tuple[int, int, int], list[Step]]:
    """Return the decisions by (world, agent, tick after the decision)."""
    found: dict[tuple[int, int, int], list[Step]] = {}
    for trip in trips:
        last = len(trip.rewards) - 1
        for n in range(last + 1):
            one = (
                trip.observations[n].tobytes(),
                np.asarray(trip.actions[n]).tobytes(),
                float(trip.rewards[n]),
                trip.terminated and n == last,
                trip.truncated and n == last,
                trip.observations[n + 1].tobytes(),
            )
            found.setdefault((trip.world, trip.agent, int(trip.ticks[n + 1])), []).append(one)
    return found


def drive(
    path: Path, mode: str, kind: str = "continuous", **more: Any
) -> list[tuple[tuple[int, int, int], Step]]:
    """Record random driving; return ((world, agent, tick), decision) for each decision."""
    seen: list[tuple[tuple[int, int, int], Step]] = []
    overrides = {"action.kind": kind, **more.pop("overrides", {})}
    with closing(
        make_vec(
            "merge", num_envs=2, agents=3, background=4, max_cycles=25, record=options(path),
            autoreset_mode=mode, overrides=overrides, **more,
        )
    ) as vec:  # fmt: skip
        observations, infos = vec.reset(seed=8)
        draw, ticks = np.random.default_rng(1), np.zeros(2, dtype=np.int64)
        for _ in range(60):
            actions: np.ndarray = draw.integers(0, 5, infos["mask"].shape)
            if kind == "continuous":
                actions = draw.uniform(-1.0, 1.0, (*infos["mask"].shape, 2)).astype(np.float32)
            before = observations.copy()
            observations, rewards, ended, cut, infos = vec.step(actions)
            ticks += vec.config.clock.ticks_per_step
            last = infos["final_observations"]
            for world, agent in zip(*np.nonzero(infos["acted"]), strict=True):
                flags = ended[world, agent], cut[world, agent]
                one = (
                    before[world, agent].tobytes(),
                    actions[world, agent].tobytes(),
                    float(rewards[world, agent]),
                    bool(flags[0] and not flags[1]),
                    bool(flags[1]),
                    last[world, agent].tobytes(),
                )
                seen.append(((int(world), int(agent), int(ticks[world])), one))
            ticks = vec.worlds.arrays.ticks.copy()
    return seen


@pytest.mark.parametrize(
    ("mode", "kind", "more"),
    [
        ("SameStep", "continuous", {}),
        ("NextStep", "continuous", {}),
        ("SameStep", "discrete", {}),
        ("SameStep", "continuous", {"zones": 2, "workers": 2}),
        ("SameStep", "continuous", {"overrides": {"sensors.stack": 2}}),
    ],
)
def test_each_decision_is_in_one_trip(
    tmp_path: Path, mode: str, kind: str, more: dict[str, Any]
) -> None:
    seen = drive(tmp_path / "run", mode, kind, **more)
    trips = list(recorded_trips(Recording.open(tmp_path / "run")))
    found = steps_of(iter(trips))
    assert sum(map(len, found.values())) == len(seen) == sum(len(trip.rewards) for trip in trips)
    last_moments = {key for key, _ in seen[-6:]}  # the end of the recording cuts trips
    for key, expected in seen:
        options_here = found[key]
        if key in last_moments and not (expected[3] or expected[4]):
            expected = (*expected[:4], True, expected[5])
            options_here = [(*one[:4], True, one[5]) for one in options_here]
        assert expected in options_here
    assert {trip.terminated for trip in trips} == {True, False}
    assert all(trip.terminated != trip.truncated for trip in trips)


def test_offline_data_do_not_depend_on_zones_and_workers(tmp_path: Path) -> None:
    drive(tmp_path / "whole", "SameStep")
    drive(tmp_path / "divided", "SameStep", zones=3, workers=2)
    whole, divided = (
        list(recorded_trips(Recording.open(tmp_path / name))) for name in ("whole", "divided")
    )
    assert len(whole) == len(divided) > 6
    for one, other in zip(whole, divided, strict=True):
        for mine, its in zip(one, other, strict=True):
            assert np.asarray(mine).tobytes() == np.asarray(its).tobytes()


def test_a_reset_truncates_the_trips(tmp_path: Path) -> None:
    with closing(parallel_env("merge", agents=2, record=options(tmp_path / "run"))) as env:
        for seed in (1, 2):
            env.reset(seed=seed)
            for _ in range(3):
                env.step(env.suggest_actions())
    trips = list(recorded_trips(Recording.open(tmp_path / "run")))
    assert [(trip.episode, trip.agent, len(trip.rewards)) for trip in trips] == [
        (0, 0, 3), (0, 1, 3), (1, 0, 3), (1, 1, 3)
    ]  # fmt: skip
    assert all(trip.truncated for trip in trips)


def test_recorded_trips_of_an_evaluation_equal_its_table(tmp_path: Path) -> None:
    evaluate(
        "merge", ["random_actions"], episodes=3, agents=3, background=4, max_cycles=60,
        seed=4, out=tmp_path / "out", record=options(tmp_path / "run"),
    )  # fmt: skip
    ((rows, _),) = load_tables(tmp_path / "out").values()
    recording = Recording.open(tmp_path / "run")
    trips = list(recorded_trips(recording))
    steps = np.rint(rows["duration_s"] / recording.head.step_s).astype(int)
    assert sorted(len(trip.rewards) for trip in trips) == sorted(steps.tolist())
    ended = sum(trip.terminated for trip in trips)
    assert ended == int((~rows["unfinished"]).sum()) > 0
    returns = sorted(float(trip.rewards.sum(dtype=np.float64)) for trip in trips)
    np.testing.assert_allclose(returns, np.sort(rows["reward"]), rtol=1e-5, atol=1e-4)


def test_recordings_without_observations_or_actions_are_refused(tmp_path: Path) -> None:
    with closing(parallel_env("merge", agents=2, record=tmp_path / "plain")) as env:
        env.reset(seed=1)
        env.step(env.suggest_actions())
    with pytest.raises(RecordingError, match="has no observations; record the run again"):
        list(recorded_trips(Recording.open(tmp_path / "plain")))
    with closing(parallel_env("merge", agents=2, record=options(tmp_path / "old"))) as env:
        env.reset(seed=1)
        env.step(env.suggest_actions())
    head = tmp_path / "old" / "recording.json"
    document = json.loads(head.read_text())
    columns = document["extras"]["observations"]
    document["extras"]["observations"] = [one for one in columns if one[0] != "action"]
    head.write_text(json.dumps(document))
    with pytest.raises(RecordingError, match="have no action, because an earlier version"):
        list(recorded_trips(Recording.open(tmp_path / "old")))
    document["extras"]["observations"] = [
        [name, "<f4", []] if name == "acted" else [name, kind, shape]
        for name, kind, shape in columns
    ]
    head.write_text(json.dumps(document))
    with pytest.raises(RecordingError, match=r"acted .* has the type float32; the rec"):
        list(recorded_trips(Recording.open(tmp_path / "old")))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recorded") / "run"
    with closing(make_vec("merge", num_envs=2, agents=3, record=options(path))) as vec:
        policy = load_policy("idm", vec)
        observations, infos = vec.reset(seed=5)
        policy.reset(5)
        for _ in range(40):
            actions = policy.act_batch(observations, infos["mask"])
            observations, *_, infos = vec.step(actions)
    return path


def test_minari_files_have_the_recorded_trips(recorded: Path, tmp_path: Path) -> None:
    from pyarrow import ipc

    recording = Recording.open(recorded)
    trips = list(recorded_trips(recording))
    assert write_minari(recording, tmp_path / "set") == (
        len(trips),
        sum(len(trip.rewards) for trip in trips),
    )
    data = tmp_path / "set" / "data"
    about = json.loads((data / "metadata.json").read_text())
    assert about["total_episodes"] == len(trips) > 3
    assert json.loads(about["action_space"]) == {
        "type": "Box", "dtype": "float32", "shape": [2], "low": [-1.0, -1.0], "high": [1.0, 1.0]
    }  # fmt: skip
    assert len(about["cavmarl_terms"]) == trips[0].terms.shape[1]
    for number, trip in enumerate(trips):
        table = ipc.open_file(data / str(number) / "part-0.arrow").read_all()
        seen = np.stack(table.column("observations").to_numpy())
        assert seen.tobytes() == trip.observations.tobytes()
        actions = np.stack(table.column("actions").to_numpy())[:-1]
        assert actions.tobytes() == trip.actions.tobytes()
        assert table.column("rewards").to_numpy()[:-1].tobytes() == trip.rewards.tobytes()
        assert table.column("truncations").to_pylist()[-2] == trip.truncated
        facts = json.loads((data / str(number) / "metadata.json").read_text())
        assert (facts["id"], facts["cavmarl_agent"]) == (number, trip.agent)


def test_minari_reads_the_data_set(recorded: Path, tmp_path: Path) -> None:
    minari = pytest.importorskip("minari")
    recording = Recording.open(recorded)
    write_minari(recording, tmp_path / "set")
    found = minari.MinariDataset(tmp_path / "set" / "data")
    trips = list(recorded_trips(recording))
    assert found.total_episodes == len(trips)
    assert found.id == "cavmarl/merge/recorded-v6"
    for episode, trip in zip(found.iterate_episodes(), trips, strict=True):
        assert episode.observations.tobytes() == trip.observations.tobytes()
        assert episode.actions.tobytes() == trip.actions.tobytes()
        assert episode.rewards.tobytes() == trip.rewards.tobytes()
        assert (episode.terminations[-1], episode.truncations[-1]) == (
            trip.terminated, trip.truncated
        )  # fmt: skip
        assert found.observation_space.contains(episode.observations[0])
        assert episode.infos["tick"].tolist() == trip.ticks.tolist()


def test_the_command_writes_minari_files_only_to_a_new_folder(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["replay", str(recorded), "--minari", str(tmp_path / "set")])
    assert ended.value.code == 0
    assert " trips, " in " ".join(capsys.readouterr().out.split())
    with pytest.raises(ConfigError, match="exists and is not an empty folder; give a new one"):
        write_minari(Recording.open(recorded), tmp_path / "set")


@pytest.mark.parametrize(
    ("section", "key", "value"), [("action", "kind", "discrete"), ("sensors", "stack", 2)]
)
def test_settings_that_do_not_fit_the_recorded_data_are_refused(
    section: str, key: str, value: Any, tmp_path: Path
) -> None:
    drive(tmp_path / "run", "SameStep")
    head = tmp_path / "run" / "recording.json"
    document = json.loads(head.read_text())
    document["manifest"]["world"]["config"][section][key] = value
    head.write_text(json.dumps(document))
    with pytest.raises(RecordingError, match="do not match the settings in its manifest; use"):
        write_minari(Recording.open(tmp_path / "run"), tmp_path / "set")
    assert not (tmp_path / "set").exists()
