"""Signals that show states of the caller: visibility, saved states, and refused commands.

Such signals are the same, bit for bit, in a divided and in an undivided world.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl import (
    ActionError,
    CapacityError,
    ConfigError,
    EpisodeError,
    parallel_env,
)
from cavmarl.core.records.codes import SIGNAL_GREEN_MAJOR, SIGNAL_RED
from cavmarl.recordings.recording import Recording
from cavmarl.roads.network import SIGNAL_STATES
from cavmarl.roads.shown_signals import signal_codes
from cavmarl.sensors.observed import feature_names
from tests.support.acted_on import hashes_of
from tests.support.saved_midway import check_resumed

ROOM = {"signals.overrides": 40}
TALKATIVE = {
    "v2x.enabled": True,
    "v2x.roadside.signals": ["all"],
    "sensors.messages.signal": True,
}


def act(env: Any, step: int) -> None:
    """Show or release states of signals if this is planned for the step."""
    if step == 1:
        for index in range(8):
            env.signal_overrides.show("B1", index, "G" if index < 4 else "r")
    if step == 6:
        env.signal_overrides.show("C2", 0, "O")
        env.signal_overrides.show("B1", 2, "y")
    if step == 15:
        env.signal_overrides.release("B1", 3)
    if step == 22:
        env.signal_overrides.release("B1")
    if step == 26:
        env.signal_overrides.show("A0", 1, "u")


hashes = partial(hashes_of, act=act, overrides=ROOM, agents=3, background=30, steps=32, every=4)


def test_a_divided_world_equals_the_undivided_one() -> None:
    undivided = hashes()
    assert hashes(zones=2) == undivided
    assert hashes(zones=4, workers=2) == undivided
    assert hashes(overrides=ROOM | {"signals.overrides": 41}) == undivided


def test_a_divided_world_with_messages_and_sensors_equals_the_undivided_one() -> None:
    more = {**TALKATIVE, "rig": {"lidar": {"type": "lidar", "rate_hz": 5, "rays": 24}}}
    assert hashes(overrides=ROOM | more, zones=3) == hashes(overrides=ROOM | more)


@pytest.mark.filterwarnings("ignore:workers = ")
def test_a_successor_of_a_dead_worker_continues() -> None:
    assert hashes(zones=4, workers=2, kill_at=(2, 23)) == hashes()


@pytest.mark.slow
def test_worlds_over_nodes_equal_the_undivided_one() -> None:
    assert hashes(zones=2, nodes=2) == hashes()


def test_saved_states_include_overridden_signals() -> None:
    check_resumed(act, ROOM, at=15, steps=30)


def test_a_signal_shows_the_given_letter_until_it_is_released_or_reset() -> None:
    env = parallel_env("grid4x4", overrides=ROOM)
    env.reset(seed=1)
    before = env.signal_overrides.letters("B1")
    env.signal_overrides.show("B1", 4, "Y")
    assert env.signal_overrides.letters("B1") == before, "the signal changes before the next step"
    env.step(env.suggest_actions())
    assert env.signal_overrides.letters("B1") == before[:4] + "Y" + before[5:]
    env.signal_overrides.release("B1", 4)
    env.step(env.suggest_actions())
    assert env.signal_overrides.letters("B1") == before
    env.signal_overrides.show("B1", 4, "Y")
    env.step(env.suggest_actions())
    env.reset(seed=1)
    env.step(env.suggest_actions())
    assert env.signal_overrides.letters("B1") == before, "a reset does not release the signal"


def test_drivers_wait_while_all_signals_are_red() -> None:
    def crossings(letter: str) -> int:
        overrides = {"signals.overrides": 400}
        env = parallel_env("grid4x4", agents=1, background=60, overrides=overrides)
        env.reset(seed=3)
        for name in env.network.signal_ids:
            for index, shown in enumerate(env.signal_overrides.letters(name)):
                if shown != "-":
                    env.signal_overrides.show(name, index, letter)
        found = 0
        internal = env.network.lanes["internal"]
        for step in range(120):
            before = {int(row["id"]): int(row["lane"]) for row in env.simulation.vehicles(0)}
            env.step(env.suggest_actions())
            if step < 60:
                continue  # first let vehicles pass that cannot stop before the line
            for row in env.simulation.vehicles(0):
                lane = before.get(int(row["id"]), -1)
                found += lane >= 0 and not internal[lane] and bool(internal[row["lane"]])
        return found

    assert crossings("r") == 0
    assert crossings("g") > 0


def test_agents_observe_overridden_states_of_signals() -> None:
    overrides = {"signals.overrides": 400, "sensors.signal.enabled": True}
    seen = []
    for letter in "Gr":
        env = parallel_env("grid4x4", agents=8, background=0, overrides=overrides)
        env.reset(seed=5)
        for name in env.network.signal_ids:
            for index, shown in enumerate(env.signal_overrides.letters(name)):
                if shown != "-":
                    env.signal_overrides.show(name, index, letter)
        observations, *_ = env.step(env.suggest_actions())
        codes = signal_codes(env.network, env.simulation.signal_phases())
        wanted = SIGNAL_GREEN_MAJOR if letter == "G" else SIGNAL_RED
        assert set(codes[env.network.links["signal"] >= 0].tolist()) == {wanted}
        seen.append(np.stack([observations[agent] for agent in sorted(observations)]))
    assert (seen[0] != seen[1]).any(axis=1).sum() > 2


def test_messages_contain_overridden_states_of_signals() -> None:
    overrides = {"signals.overrides": 400, **TALKATIVE, "v2x.roadside.rate_hz": 10.0}
    env = parallel_env("grid4x4", agents=8, background=0, overrides=overrides)
    env.reset(seed=5)
    plain = parallel_env("grid4x4", agents=8, background=0, overrides=overrides)
    plain.reset(seed=5)
    for name in env.network.signal_ids:
        for index, shown in enumerate(env.signal_overrides.letters(name)):
            if shown != "-":
                env.signal_overrides.show(name, index, "G")
    features = feature_names(env.config.sensors).index(("messages", "signal_go"))
    for _ in range(4):
        seen = env.step(env.suggest_actions())[0]
        other = plain.step(plain.suggest_actions())[0]
    greens = np.array([seen[agent][features] for agent in sorted(seen)])
    programs = np.array([other[agent][features] for agent in sorted(other)])
    assert greens.sum() > programs.sum()
    reports = env.simulation.messages.mail.signals[0]
    heard = reports[reports["sender"] >= 0]
    assert len(heard) > 0
    assert (heard["code"] < 0).all()
    assert (heard["left_s"] == 0.0).all()


def test_recordings_and_drawings_show_overridden_signals(tmp_path: Path) -> None:
    path = tmp_path / "shown"
    env = parallel_env("grid4x4", overrides=ROOM, record=str(path))
    env.reset(seed=1)
    env.step(env.suggest_actions())
    env.signal_overrides.show("B1", 4, "Y")
    for _ in range(2):
        env.step(env.suggest_actions())
    env.signal_overrides.release("B1")
    env.step(env.suggest_actions())
    links = env.network.links
    row = env.network.signal_ids.index("B1")
    link = int(np.flatnonzero((links["signal"] == row) & (links["signal_index"] == 4))[0])
    env.close()
    recording = Recording(path)
    shown = [
        SIGNAL_STATES[signal_codes(recording.network, frame.signals)[link]]
        for frame in recording.frames()
    ]
    recording.check_on_map(recording.at(6))
    told = [one.event.detail for one in recording.events() if "link" in one.event.detail]
    assert shown[0] == shown[1] == shown[4]
    assert shown[2:4] == ["Y", "Y"]
    assert told == [f"link {link}: shows Y", f"link {link}: shows its program"]


def test_wrong_commands_are_refused_with_a_remedy() -> None:
    env = parallel_env("grid4x4", overrides={"signals.overrides": 2})
    with pytest.raises(EpisodeError, match="before reset"):
        env.signal_overrides.show("A0", 0, "G")
    env.reset(seed=1)
    with pytest.raises(ActionError, match=r"signal 'Z9': there is no such signal; the map has A0"):
        env.signal_overrides.show("Z9", 0, "G")
    with pytest.raises(ActionError, match=r"signal 'A0', index 99: no link has this index; must"):
        env.signal_overrides.show("A0", 99, "G")
    with pytest.raises(ActionError, match=r"letter = 'x': must be one of rugGysoOY"):
        env.signal_overrides.show("A0", 0, "x")
    with pytest.raises(ActionError, match="letter = '': must be"):
        env.signal_overrides.show("A0", 0, "")
    with pytest.raises(ActionError, match="world 1: must be from 0 to 0"):
        env.signal_overrides.release("A0", world=1)
    env.signal_overrides.show("A0", 0, "G")
    env.signal_overrides.show("A0", 0, "r")
    env.signal_overrides.show("A0", 1, "r")
    with pytest.raises(CapacityError, match=r"signals\.overrides = 2 links show"):
        env.signal_overrides.show("A0", 2, "r")
    env.signal_overrides.release("A0", 0)
    env.signal_overrides.show("A0", 2, "r")
    without = parallel_env("grid4x4")
    without.reset(seed=1)
    with pytest.raises(ConfigError, match=r"set signals\.overrides to the number of links"):
        without.signal_overrides.show("A0", 0, "G")


def test_worlds_with_sumos_traffic_refuse_overrides() -> None:
    sumo = {"traffic.source": "sumo-traffic", "traffic.demand": ["any.sumocfg"]}
    overrides = {**ROOM, **sumo, "sensors.signal.timing": False}
    with pytest.raises(ConfigError, match=r"signals\.overrides = 40: .*SUMO runs the signals"):
        parallel_env("grid4x4", overrides=overrides)
