"""A run with clients is repeated from its recording without the clients."""

from __future__ import annotations

import json
import shutil
import threading
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import cavmarl
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ActionError, ConfigError, RecordingError
from cavmarl.core.records.codes import DRIVER_EXTERNAL
from cavmarl.core.records.external_records import EXTERNAL
from cavmarl.cosim.followers.followed_world import FollowedWorld
from cavmarl.cosim.followers.follower_client import Follower
from cavmarl.cosim.followers.follower_messages import ActorRequest, PoseView
from cavmarl.env.recorded_inputs import INPUTS
from cavmarl.recordings.extra_tables import RecordOptions
from cavmarl.recordings.recording import Recording
from cavmarl.verify.recorded_runs import repeat_recording
from tests.cosim.test_client_actors import SETTINGS

pytestmark = pytest.mark.integration  # a recording starts git to read the commit

SPEC = WorldSpec(env="grid4x4", agents=2, background=12, overrides=SETTINGS)
STEP_S = 0.05


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """Return a recording of two episodes with a client, and the hash of each state."""
    folder = tmp_path_factory.mktemp("recorded")
    address = folder / "s"
    env = cavmarl.parallel_env(
        SPEC.env, record=RecordOptions(folder / "run", (INPUTS,)), **SPEC.keywords
    )
    min_x, min_y, _, _ = env.network.extent_m

    def client() -> None:
        random = np.random.default_rng(0)
        actors = [
            ActorRequest("walker", "pedestrian", min_x, min_y, 0.0, rate_hz=20.0),
            ActorRequest("car", "car", min_x, min_y + 9.0, 0.0, moved_by="controls"),
        ]
        with Follower(address, ["car_1"], "client", actors=actors) as follower:
            for view in follower:
                if view.snapshot.is_over:
                    continue
                end_s = view.snapshot.time_s + STEP_S
                pose = PoseView(end_s, min_x + end_s, min_y + float(random.random()), 0.0)
                controls = {"car": [0.3, 0.05], "car_1": random.uniform(-1.0, 1.0, 2).tolist()}
                follower.answer(controls, {"walker": [pose]})

    found = []
    thread = threading.Thread(target=client)
    with closing(env), FollowedWorld(env, address) as world:
        thread.start()
        world.wait_for(1, 10.0)
        for seed in (4, None):
            world.reset(seed)
            found.append(env.state_hash())
            for _ in range(25):
                world.step()
                found.append(env.state_hash())
    thread.join(10.0)
    return folder / "run", found


def test_the_recording_has_the_inputs_of_each_step(recorded: tuple[Path, list[str]]) -> None:
    path, found = recorded
    rows = Recording.open(path).extra(INPUTS)
    assert rows["state_hash"].tolist() == found
    assert rows["kind"].tolist() == (["reset"] + ["step"] * 25) * 2
    assert [seed for seed in rows["seed"].tolist() if seed] == ["4"]
    assert rows["external"].any()
    drivers = {
        int(row["driver"]) for frame in Recording.open(path).frames() for row in frame.vehicles
    }
    assert DRIVER_EXTERNAL in drivers  # the frames of the recording contain external vehicles


@pytest.mark.parametrize("zones", [1, 3])
def test_a_run_is_repeated_without_its_clients(
    recorded: tuple[Path, list[str]], zones: int
) -> None:
    path, found = recorded
    repeated = repeat_recording(path, SPEC, zones=zones)
    assert repeated.first_difference is None
    assert (repeated.steps, repeated.episodes) == (50, 2)
    assert repeated.state_hash == found[-1]


def test_a_changed_command_is_reported_as_the_first_difference(
    recorded: tuple[Path, list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    read = Recording.extra

    def changed(self: Recording, table: str, *arguments: Any) -> Any:
        rows = read(self, table, *arguments)
        rows["controls"][30, 1, 0] += 0.25
        return rows

    monkeypatch.setattr(Recording, "extra", changed)
    repeated = repeat_recording(recorded[0], SPEC)
    assert repeated.first_difference == (30, 4)


def test_another_world_is_refused_with_the_keys_that_differ(
    recorded: tuple[Path, list[str]],
) -> None:
    other = replace(SPEC, overrides={**SETTINGS, "population.external": 2}, background=11)
    with pytest.raises(
        ConfigError,
        match=r"population\.background = 11, recorded with 12; population\.external = 2, recorded",
    ):
        repeat_recording(recorded[0], other)
    with pytest.raises(ConfigError, match="on another map"):
        repeat_recording(recorded[0], replace(SPEC, env="ring"))


def test_settings_newer_than_a_recording_get_their_defaults(
    recorded: tuple[Path, list[str]], tmp_path: Path
) -> None:
    path, found = recorded
    older = tmp_path / "older"
    shutil.copytree(path, older)
    manifest = json.loads((older / "recording.json").read_text(encoding="utf-8"))
    del manifest["manifest"]["world"]["config"]["scenario"]["seats"]
    del manifest["manifest"]["world"]["config"]["map"]["changed_lanes"]
    (older / "recording.json").write_text(json.dumps(manifest), encoding="utf-8")
    assert repeat_recording(older, SPEC).state_hash == found[-1]
    other = replace(SPEC, overrides={**SETTINGS, "map.changed_lanes": 2})
    with pytest.raises(ConfigError, match=r"map\.changed_lanes = 2, recorded with 0"):
        repeat_recording(older, other)


def test_a_recording_without_commands_cannot_be_repeated(tmp_path: Path) -> None:
    with closing(cavmarl.parallel_env("ring", agents=1, record=tmp_path / "a")) as env:
        env.reset(seed=0)
        env.step(env.suggest_actions())
    with pytest.raises(ConfigError, match="has no commands, so it cannot be repeated"):
        repeat_recording(tmp_path / "a", WorldSpec(env="ring", agents=1))


def test_a_recording_that_starts_during_an_episode_cannot_be_repeated(tmp_path: Path) -> None:
    with closing(cavmarl.parallel_env("ring", agents=1)) as env:
        env.reset(seed=0)
        env.record(RecordOptions(tmp_path / "a", (INPUTS,)))
        env.step(env.suggest_actions())
    with pytest.raises(RecordingError, match="does not begin with a reset"):
        repeat_recording(tmp_path / "a", WorldSpec(env="ring", agents=1))


@pytest.mark.parametrize("num_envs", [1, 2])
def test_commands_of_vector_environments_cannot_be_recorded(num_envs: int, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="only the commands of one world of `parallel_env`"):
        cavmarl.make_vec("ring", num_envs=num_envs, record=RecordOptions(tmp_path / "a", (INPUTS,)))


def test_the_command_repeats_a_recording(recorded: tuple[Path, list[str]], tmp_path: Path) -> None:
    from cavmarl.cli import app

    settings = [f"--set={key}={value}" for key, value in SETTINGS.items()]
    words = ["verify", "recording", "grid4x4", "--recording", str(recorded[0]), *settings]
    file = tmp_path / "found.json"
    result = CliRunner().invoke(
        app, [*words, "--agents", "2", "--background", "12", "--json", str(file)]
    )
    assert result.exit_code == 0, result.output
    assert "equal: 50 steps in 2 episodes" in result.output
    assert json.loads(file.read_text())["state_hash"] == recorded[1][-1]


EVERY_INPUT = {
    "v2x.enabled": True,
    "map.changed_lanes": 8,
    "population.insertions": 4,
    "signals.controller": "max_pressure",
}


@pytest.mark.parametrize(
    "overrides",
    [EVERY_INPUT, {"action.kind": "discrete"}, {"signals.agents": "all"}],
    ids=["messages, roads, insertions", "choices", "signals"],
)
def test_inputs_of_all_kinds_are_repeated(tmp_path: Path, overrides: dict[str, Any]) -> None:
    spec = WorldSpec(env="grid4x4", agents=3, background=10, overrides=overrides)
    record = RecordOptions(tmp_path / "run", (INPUTS,))
    with closing(cavmarl.parallel_env(spec.env, record=record, **spec.keywords)) as env:
        env.reset(seed=3)
        for agent in env.agents:
            env.action_space(agent).seed(0)
        for step in range(20):
            if overrides is EVERY_INPUT and step == 2:
                env.close_road("B1B2")
                lane = int(np.flatnonzero(~env.network.lanes["internal"])[4])
                env.insert_vehicle(env.network.lane_ids[lane], 20.0)
                env.declare_event(env.agents[0], "obstacle")
            if env.agents:
                env.step({agent: env.action_space(agent).sample() for agent in env.agents})
        expected = env.state_hash()
    repeated = repeat_recording(tmp_path / "run", spec)
    assert (repeated.first_difference, repeated.state_hash) == (None, expected)


VTYPE = (EXTERNAL.names or ()).index("vtype")


@pytest.fixture(scope="module")
def recording_of_commands(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, WorldSpec]:
    """Return a recording whose first step has commands of almost all kinds, and its world."""
    more = {"signals.overrides": 4, "population.external": 2}
    overrides = {**EVERY_INPUT, **more, "signals.agents": "all"}
    spec = WorldSpec(env="grid4x4", agents=2, background=4, overrides=overrides)
    path = tmp_path_factory.mktemp("every") / "run"
    with closing(
        cavmarl.parallel_env(spec.env, record=RecordOptions(path, (INPUTS,)), **spec.keywords)
    ) as env:
        env.reset(seed=3)
        min_x, min_y, _, _ = env.network.extent_m
        env.external.spawn(min_x, min_y, 0.0)
        env.step(env.suggest_actions())
    return path, spec


@pytest.mark.parametrize(
    ("name", "place", "value", "reason"),
    [
        ("kind", (), "y", "a row is neither a reset nor a step"),
        ("controls", (0, 0), np.nan, "a control is not finite"),
        ("meta_actions", (0,), 9, "a choice of a vehicle is unknown"),
        ("declared", (0,), 9999, "an event has an unknown code"),
        ("inserted", (0,), (1.0, 1e9, 1.0), "an insertion is on a lane that does not exist"),
        ("external", (0, 1), np.nan, "an external vehicle has an invalid x"),
        ("external", (0, VTYPE), 1e9, "an external vehicle has an unknown type"),
        ("overridden", (0,), (1 << 30, 3), "a link without a signal shows a state"),
        ("lane_changes", (0, 0), 1e9, "a changed lane does not exist"),
        ("signal_choices", (0,), 99, "a choice of a signal or of a speed limit is out of range"),
    ],
)
def test_a_forged_command_is_refused(
    recording_of_commands: tuple[Path, WorldSpec],
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    place: tuple[int, ...],
    value: Any,
    reason: str,
) -> None:
    forge(monkeypatch, name, (1, *place), value)
    with pytest.raises((RecordingError, ActionError), match=reason):
        repeat_recording(*recording_of_commands)


def test_a_forged_seed_is_refused(
    recording_of_commands: tuple[Path, WorldSpec], monkeypatch: pytest.MonkeyPatch
) -> None:
    forge(monkeypatch, "seed", (0,), "4x")
    with pytest.raises(RecordingError, match=r"seed = '4x': must be a whole number; get the"):
        repeat_recording(*recording_of_commands)


def test_commands_with_another_dtype_are_refused(
    recording_of_commands: tuple[Path, WorldSpec], monkeypatch: pytest.MonkeyPatch
) -> None:
    read = Recording.extra

    def changed(self: Recording, table: str, *arguments: Any) -> Any:
        rows: Any = read(self, table, *arguments)
        return rows[[column for column in rows.dtype.names if column != "controls"]]

    monkeypatch.setattr(Recording, "extra", changed)
    with pytest.raises(
        RecordingError, match="the column controls of its commands does not fit this world"
    ):
        repeat_recording(*recording_of_commands)


def forge(monkeypatch: pytest.MonkeyPatch, name: str, place: tuple[int, ...], value: Any) -> None:
    """Replace a value in a column of each recording that is read."""
    read = Recording.extra

    def changed(self: Recording, table: str, *arguments: Any) -> Any:
        rows = read(self, table, *arguments)
        rows[name][place] = value
        return rows

    monkeypatch.setattr(Recording, "extra", changed)
