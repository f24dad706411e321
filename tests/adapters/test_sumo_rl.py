"""The API of sumo-rl 1.4.5: its arguments, spaces, results and files."""

from __future__ import annotations

import csv
import pickle
import re
import shutil
import warnings
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import sumolib
from gymnasium import spaces
from numpy.typing import NDArray

from cavmarl import parallel_env
from cavmarl.adapters import sumo_rl
from cavmarl.adapters.sumo_rl import SumoEnvironment, TrafficSignal
from cavmarl.adapters.sumo_rl.agents import QLAgent
from cavmarl.adapters.sumo_rl.exploration import EpsilonGreedy
from cavmarl.config.registry import find_entry
from cavmarl.core.errors import (
    ActionError,
    CavmarlError,
    ConfigError,
    DemandError,
    EpisodeError,
    MapError,
)
from cavmarl.roads.network import SIGNAL_STATES

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import api_test, parallel_api_test

NET = find_entry("grid4x4") / "map" / "map.net.xml"
ROUTES = [("left0A0", "D0right0"), ("top1B3", "B0bottom1"), ("right2D2", "A2left2"),
          ("bottom3D0", "D3top3"), ("left3A3", "D3right3"), ("bottom0A0", "A3top0")]  # fmt: skip
NAMED = re.compile("We recommend agents to be named")


@pytest.fixture(scope="module")
def routes(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Write demand with a vehicle every 6 s on each of ROUTES; return its path."""
    flows = [
        f'<flow id="f{k}" begin="0" end="3600" period="6" from="{start}" to="{end}"/>'
        for k, (start, end) in enumerate(ROUTES)
    ]
    path = tmp_path_factory.mktemp("routes") / "flows.rou.xml"
    path.write_text("<routes>" + "".join(flows) + "</routes>", encoding="utf-8")
    return str(path)


def grid(routes: str, **more: Any) -> SumoEnvironment:
    return SumoEnvironment(str(NET), routes, **{"num_seconds": 100, "sumo_seed": 7, **more})


def drive(env: SumoEnvironment, steps: int, every: int = 4) -> list[Any]:
    """Step with the same green for all signals; change to the next green every `every` steps."""
    return [
        env.step({ts: k // every % env.action_spaces(ts).n for ts in env.ts_ids})
        for k in range(steps)
    ]


# Signals


def test_signals_lanes_and_phases_equal_those_of_the_map_file(routes: str) -> None:
    net = sumolib.net.readNet(str(NET), withPrograms=True)
    with closing(grid(routes, yellow_time=3)) as env:
        assert env.ts_ids == sorted(light.getID() for light in net.getTrafficLights())
        for light in net.getTrafficLights():
            signal = env.traffic_signals[light.getID()]
            links = sorted(light.getConnections(), key=lambda link: link[2])
            assert signal.lanes == [*dict.fromkeys(lane.getID() for lane, _, _ in links)]
            assert signal.out_lanes == [*dict.fromkeys(lane.getID() for _, lane, _ in links)]
            for lane in {lane for link in links for lane in link[:2]}:
                assert signal.lanes_length[lane.getID()] == pytest.approx(lane.getLength(), abs=0.1)
            (program,) = light.getPrograms().values()
            states = [phase.state for phase in program.getPhases()]
            greens = [state for state in states if "y" not in state and set(state) - {"r"}]
            assert [phase.state for phase in signal.green_phases] == greens
            assert signal.num_green_phases == len(greens)
            for (i, j), row in signal.yellow_dict.items():
                duration, state = signal.all_phases[row]
                assert duration == 3
                for old, new, shown in zip(greens[i], greens[j], state, strict=True):
                    assert shown == ("y" if old in "gG" and new == "r" else old)
            size = len(greens) + 1 + 2 * len(signal.lanes)
            assert signal.observation_space == spaces.Box(0.0, 1.0, (size,), np.float32)
            assert signal.action_space == spaces.Discrete(len(greens))


def test_greens_are_counted_as_in_sumo_rl(routes: str, tmp_path: Path) -> None:
    """sumo-rl counts repeated phases and phases with `Y` as greens; cavmarl's own API does not."""
    with closing(grid(routes)) as env:
        first, second = (phase.state for phase in env.traffic_signals["A0"].green_phases)
        size = len(first)
    odd = "Y" * size
    states = [first, "y" * size, second, "r" * size, first, odd, "s" * size]
    phases = "".join(f'<phase duration="10" state="{state}"/>' for state in states)
    file = tmp_path / "programs.add.xml"
    file.write_text(
        '<additional><tlLogic id="A0" type="static" programID="other" offset="0">'
        f"{phases}</tlLogic></additional>",
        encoding="utf-8",
    )
    with closing(grid(routes, additional_sumo_cmd=f"-a {file}")) as env:
        signal = env.traffic_signals["A0"]
        assert [phase.state for phase in signal.green_phases] == [first, second, first, odd]
        assert signal.all_phases[signal.yellow_dict[0, 2]].state == first
        assert env.reset()["A0"][:4].tolist() == [1.0, 0.0, 0.0, 0.0]
        env.step({"A0": 2})
        env.step({"A0": 2})
        observations, *_ = env.step({"A0": 2})
        assert observations["A0"][:4].tolist() == [0.0, 0.0, 1.0, 0.0]
    overrides = {"map.programs": [str(file)], "signals.agents": ["A0"], "clock.ctrl_dt_s": 1.0}
    with closing(parallel_env(str(NET), agents=0, background=0, overrides=overrides)) as env:
        assert env.action_space("signal_A0") == spaces.Discrete(2)


def test_greens_change_at_the_times_of_sumo_rl(routes: str) -> None:
    """As in sumo-rl, a change is ignored until yellow and the minimum green have passed."""
    rng = np.random.default_rng(1)
    with closing(grid(routes, min_green=8, yellow_time=3, num_seconds=300)) as env:
        env.reset()
        green = dict.fromkeys(env.ts_ids, 0)
        since = dict.fromkeys(env.ts_ids, 0)
        for _ in range(60):
            actions = {ts: int(rng.integers(env.action_spaces(ts).n)) for ts in env.ts_ids}
            observations, *_ = env.step(actions)
            for ts, action in actions.items():
                if action != green[ts] and since[ts] >= 8 + 3:
                    green[ts], since[ts] = action, 0
                since[ts] += 5
                signal = env.traffic_signals[ts]
                assert (signal.green_phase, signal.time_since_last_phase_change) == (
                    green[ts],
                    since[ts],
                )
                head = observations[ts][: signal.num_green_phases + 1].tolist()
                one_hot = [float(k == green[ts]) for k in range(signal.num_green_phases)]
                assert head == [*one_hot, float(since[ts] >= 8 + 3)]
                assert not signal.is_yellow
                assert signal.time_to_act
                assert signal.next_action_time == env.sim_step


def test_the_longest_green_is_enforced_only_on_request(routes: str) -> None:
    def last_green(**more: Any) -> int:
        with closing(grid(routes, max_green=20, **more)) as env:
            env.reset()
            for _ in range(6):
                env.step(dict.fromkeys(env.ts_ids, 0))
            return env.traffic_signals["A0"].green_phase

    assert last_green() == 0
    assert last_green(enforce_max_green=True) == 1


def test_signals_without_an_action_keep_their_green(routes: str) -> None:
    with closing(grid(routes)) as env:
        env.reset()
        for action in (None, {}, {"A1": 1}, {"A1": 1}, {"A1": 1}):
            observations, rewards, dones, _ = env.step(action)
            assert observations.keys() == rewards.keys() == set(env.ts_ids)
            assert dones == {"__all__": False} | dict.fromkeys(env.ts_ids, False)
        assert env.traffic_signals["A1"].green_phase == 1
        assert env.traffic_signals["A0"].green_phase == 0


# Observations, rewards and infos


def on_lanes(env: SumoEnvironment, lanes: list[str]) -> NDArray[np.void]:
    rows = env.world.simulation.vehicles(0)
    names = np.array(env.world.network.lane_ids)[rows["lane"]]
    return rows[np.isin(names, lanes)]


def test_observations_and_rewards_follow_the_formulas_of_sumo_rl(routes: str) -> None:
    """Compare with formulas over all vehicles, and with the signal agents of the world."""
    names = ["average-speed", "queue", "pressure", "diff-waiting-time"]
    with closing(grid(routes, num_seconds=400, reward_fn=names)) as env:
        env.reset()
        seen = 0
        for _ in range(80):
            _, rewards, _, info = drive(env, 1)[0]
            outputs = env.world.simulation.signals.outputs
            for s, ts in enumerate(env.world.table.ids):
                signal = env.traffic_signals[ts]
                before, behind = on_lanes(env, signal.lanes), on_lanes(env, signal.out_lanes)
                stands = before["speed"] < 0.1
                limits = env.world.network.lanes["speed_mps"][before["lane"]]
                shares = before["speed"] / (limits * before["speed_factor"])
                mean_speed = shares.mean() if shares.size else 1.0
                assert rewards[ts][0] == pytest.approx(mean_speed, abs=1e-5)
                assert rewards[ts][1] == -stands.sum()
                assert rewards[ts][2] == len(behind) - len(before)
                assert rewards[ts] == pytest.approx(outputs.terms[0, s][[1, 2, 3, 0]], abs=1e-4)
                observation = env.observations[ts]
                engine = outputs.observations[0, s, : observation.size]
                np.testing.assert_allclose(observation, engine, atol=1e-6)
                for lane, density, queue in zip(
                    signal.lanes, signal.get_lanes_density(), signal.get_lanes_queue(), strict=True
                ):
                    rows = on_lanes(env, [lane])
                    mean_m = rows["length"].mean() if rows.size else 0.0
                    room = signal.lanes_length[lane] / (2.5 + mean_m)
                    assert density == pytest.approx(min(1.0, len(rows) / room), abs=1e-6)
                    standing = np.count_nonzero(rows["speed"] < 0.1)
                    assert queue == pytest.approx(min(1.0, standing / room), abs=1e-6)
                    seen += standing
                assert info[f"{ts}_stopped"] == stands.sum()
                waited = sum(signal.get_accumulated_waiting_time_per_lane())
                assert signal.last_measure == pytest.approx(waited / 100.0)
                assert signal.last_reward is env.rewards[ts]
        assert seen > 100


def test_infos_have_the_values_of_sumo_rl(routes: str) -> None:
    with closing(grid(routes)) as env:
        env.reset()
        info = drive(env, 20)[-1][3]
        rows = env.world.simulation.vehicles(0)
        assert info["step"] == 100.0
        assert info["system_total_stopped"] == np.count_nonzero(np.abs(rows["speed"]) < 0.1)
        assert info["system_total_waiting_time"] == pytest.approx(rows["wait_s"].sum())
        assert info["system_mean_waiting_time"] == pytest.approx(rows["wait_s"].mean())
        assert info["system_mean_speed"] == pytest.approx(np.abs(rows["speed"]).mean())
        for name in ("stopped", "accumulated_waiting_time"):
            total = sum(info[f"{ts}_{name}"] for ts in env.ts_ids)
            assert info[f"agents_total_{name}"] == pytest.approx(total)
        assert info["agents_total_stopped"] > 0
    with closing(grid(routes, add_system_info=False, add_per_agent_info=False)) as env:
        env.reset()
        assert drive(env, 1)[0][3] == {"step": 5.0}


def test_a_csv_file_is_written_for_each_episode(routes: str, tmp_path: Path) -> None:
    with closing(grid(routes, out_csv_name=str(tmp_path / "new" / "run"), begin_time=50)) as env:
        env.reset()
        infos = [step[3] for step in drive(env, 20)]
        env.reset()
        name = f"run_conn{env.label}_ep1.csv"
        assert [path.name for path in (tmp_path / "new").iterdir()] == [name]
        with (tmp_path / "new" / name).open(encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        per_agent = ("stopped", "accumulated_waiting_time", "average_speed")
        assert list(rows[0]) == [
            "step",
            "system_total_stopped",
            "system_total_waiting_time",
            "system_mean_waiting_time",
            "system_mean_speed",
            *(f"{ts}_{value}" for ts in env.ts_ids for value in per_agent),
            "agents_total_stopped",
            "agents_total_accumulated_waiting_time",
        ]
        assert [{k: float(v) for k, v in row.items()} for row in rows] == infos
        assert [row["step"] for row in rows] == [f"{t:.1f}" for t in range(55, 151, 5)]


def test_users_can_define_rewards_and_observations(routes: str) -> None:
    class Queues(sumo_rl.ObservationFunction):
        def __call__(self) -> NDArray[np.float32]:
            return np.array(self.ts.get_lanes_queue(), dtype=np.float32)

        def observation_space(self) -> spaces.Box:
            return spaces.Box(0.0, 1.0, (len(self.ts.lanes),), np.float32)

    def speed(signal: TrafficSignal) -> float:
        return 2.0 * signal.get_average_speed()

    more: dict[str, Any] = {"observation_class": Queues}
    with closing(grid(routes, reward_fn=speed, **more)) as env:
        observations = env.reset()
        _, rewards, *_ = drive(env, 3)[-1]
        for ts, signal in env.traffic_signals.items():
            assert observations[ts].shape == (len(signal.lanes),)
            assert rewards[ts] == 2.0 * signal.get_average_speed()
    of_each = {f"{column}{row}": "queue" for column in "ABCD" for row in range(4)}
    with closing(grid(routes, reward_fn=of_each | {"A0": speed})) as env:
        env.reset()
        _, rewards, *_ = drive(env, 3)[-1]
        assert rewards["A0"] == 2.0 * env.traffic_signals["A0"].get_average_speed()
        assert rewards["B0"] == -env.traffic_signals["B0"].get_total_queued()
    with closing(grid(routes, reward_fn=["queue", speed], reward_weights=[1.0, -3.0])) as env:
        env.reset()
        _, rewards, *_ = drive(env, 8)[-1]
        signal = env.traffic_signals["A0"]
        expected = -signal.get_total_queued() - 6.0 * signal.get_average_speed()
        assert rewards["A0"] == pytest.approx(expected, abs=1e-5)
        assert env.reward_dim == 1
        assert env.reward_space.shape == (1,)


def test_rewards_can_be_registered(routes: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TrafficSignal, "reward_fns", dict(TrafficSignal.reward_fns))

    def crowd(signal: TrafficSignal) -> float:
        return sum(signal.get_out_lanes_density())

    TrafficSignal.register_reward_fn(crowd)
    with pytest.raises(ConfigError, match=r"a reward 'crowd' exists already; rename it"):
        TrafficSignal.register_reward_fn(crowd)
    with closing(grid(routes, reward_fn="crowd")) as env:
        env.reset()
        rewards = drive(env, 10)[-1][1]
        assert max(rewards.values()) > 0.0
        for ts, signal in env.traffic_signals.items():
            assert rewards[ts] == crowd(signal)


def test_fixed_signals_follow_the_programs_of_the_map(routes: str) -> None:
    net = sumolib.net.readNet(str(NET), withPrograms=True)
    with closing(grid(routes, fixed_ts=True, num_seconds=300)) as env:
        env.reset()
        stopped = 0
        for _ in range(60):
            observations, _, _, info = env.step(None)
            simulation, network = env.world.simulation, env.world.network
            for row, name in enumerate(network.signal_ids):
                phase = network.phases[simulation.signal_phases(0)[row]]
                first, count = phase["first_state"], network.signals["num_links"][row]
                codes = network.phase_states[first : first + count]
                (program,) = net.getTLS(name).getPrograms().values()
                phases = program.getPhases()
                now = env.sim_step % sum(each.duration for each in phases)
                for each in phases:
                    if now < each.duration:
                        break
                    now -= each.duration
                assert "".join(SIGNAL_STATES[code] for code in codes) == each.state
                signal = env.traffic_signals[name]
                assert signal.num_green_phases == len(phases) // 2
                rows = on_lanes(env, signal.lanes)
                assert info[f"{name}_stopped"] == np.count_nonzero(np.abs(rows["speed"]) < 0.1)
                assert observations[name].shape == signal.observation_space.shape
                stopped += info[f"{name}_stopped"]
        assert stopped > 50
        assert info["agents_total_accumulated_waiting_time"] > 0.0


# Episodes


def test_a_seed_repeats_an_episode(routes: str) -> None:
    def run(env: SumoEnvironment, seed: int | None = None) -> list[float]:
        env.reset(seed=seed)
        return [step[3]["system_mean_speed"] for step in drive(env, 20)]

    with closing(grid(routes, sumo_seed="7")) as env:
        first = run(env)
        assert run(env) == first
        assert run(env, seed=8) != first
        assert run(env, seed=7) == first
        env.close()
        assert run(env) == first  # a closed environment makes a new world
    with closing(grid(routes, sumo_seed="random")) as env:
        assert run(env) != run(env)
        assert run(env, seed=7) == first


def test_a_copy_is_a_new_environment(routes: str) -> None:
    with closing(grid(routes)) as env:
        env.reset()
        drive(env, 3)
        with closing(pickle.loads(pickle.dumps(env))) as other:
            assert other.label != env.label
            for ts, seen in env.reset().items():
                np.testing.assert_array_equal(seen, other.reset()[ts])


def test_an_episode_ends_after_its_seconds(routes: str) -> None:
    with closing(grid(routes, num_seconds=12, begin_time=100)) as env:
        with pytest.raises(EpisodeError, match=r"step\(\) before reset\(\)"):
            env.step({})
        env.reset()
        dones = [step[2]["__all__"] for step in drive(env, 3)]
        assert dones == [False, False, True]
        assert (env.sim_max_time, env.sim_step) == (112, 115.0)
        with pytest.raises(EpisodeError, match=r"the episode is over: call reset\(\)"):
            env.step({})
        env.reset()
        env.step({})
    with pytest.raises(EpisodeError, match=r"closed: call reset\(\)"):
        env.step({})


def test_options_of_sumo_are_applied_to_the_demand(routes: str, tmp_path: Path) -> None:
    def departed(options: str | None) -> int:
        with closing(grid(routes, additional_sumo_cmd=options)) as env:
            env.reset()
            drive(env, 20)
            return env.world.simulation.traffic_stats().departed

    closed = tmp_path / "closed.add.xml"
    closed.write_text("<additional/>", encoding="utf-8")
    once = departed(None)
    assert once > 80
    assert departed("--scale 0.5 --no-warnings --duration-log.statistics") < 0.6 * once
    assert departed(f"-a {closed} --scale=0.5") < 0.6 * once


# Libraries


def test_one_signal_is_a_gymnasium_environment(routes: str) -> None:
    env = gymnasium.make("sumo-rl-v0", net_file=str(NET), route_file=routes, num_seconds=50)
    with closing(env):
        observation, info = env.reset(seed=3)
        assert env.observation_space.contains(observation)
        assert info["step"] == 0.0
        ends = []
        for k in range(10):
            observation, reward, terminated, truncated, info = env.step(k % 2)
            ends.append((terminated, truncated))
        assert isinstance(reward, float)
        assert ends == [(False, False)] * 9 + [(False, True)]
        assert info["step"] == 50.0


def test_dqn_learns_on_one_signal(routes: str) -> None:
    pytest.importorskip("torch", reason="needs the extra: train")
    library = pytest.importorskip("stable_baselines3", reason="needs the extra: train")
    with closing(grid(routes, single_agent=True)) as env:
        model = library.DQN("MlpPolicy", env, learning_starts=0, train_freq=1, seed=1)
        model.learn(total_timesteps=50)
        assert env.episode >= 3
        assert env.world.simulation.traffic_stats().departed > 0


def test_ppo_learns_one_policy_for_all_signals(routes: str) -> None:
    pytest.importorskip("torch", reason="needs the extra: train")
    library = pytest.importorskip("stable_baselines3", reason="needs the extra: train")
    supersuit = pytest.importorskip("supersuit", reason="needs the extra: bench")
    env = sumo_rl.parallel_env(net_file=str(NET), route_file=routes, num_seconds=50)
    # Signals at the edge of the grid have fewer lanes, so their spaces are padded.
    env = supersuit.pad_action_space_v0(supersuit.pad_observations_v0(env))
    env = supersuit.pettingzoo_env_to_vec_env_v1(env)
    env = supersuit.concat_vec_envs_v1(env, 2, num_cpus=1, base_class="stable_baselines3")
    model = library.PPO("MlpPolicy", env, n_steps=10, batch_size=64, n_epochs=1)
    model.learn(total_timesteps=10 * env.num_envs)
    assert env.num_envs == 32
    assert model.num_timesteps == 320


def test_q_learning_runs_with_a_table_for_each_signal(routes: str) -> None:
    with closing(grid(routes, num_seconds=200)) as env:
        states = env.reset()
        agents = {
            ts: QLAgent(
                starting_state=env.encode(states[ts], ts),
                state_space=env.observation_space,
                action_space=env.action_spaces(ts),
                alpha=0.1,
                gamma=0.99,
                exploration_strategy=EpsilonGreedy(0.05, 0.005, decay=1),
            )
            for ts in env.ts_ids
        }
        done = {"__all__": False}
        while not done["__all__"]:
            states, rewards, done, _ = env.step({ts: agents[ts].act() for ts in agents})
            for ts, agent in agents.items():
                agent.learn(next_state=env.encode(states[ts], ts), reward=rewards[ts])
        assert sum(len(agent.q_table) for agent in agents.values()) > 3 * len(agents)
        assert any(agent.acc_reward for agent in agents.values())


def test_q_learning_follows_its_update_rule_and_explores() -> None:
    space = spaces.Discrete(2)
    agent = QLAgent("a", None, space, alpha=0.5, gamma=0.5)
    with pytest.raises(ValueError, match="choose an action first"):
        agent.learn("b", 1.0)
    agent.action = 1
    agent.q_table["b"] = [3.0, 4.0]
    agent.learn("b", 2.0)
    assert agent.q_table["a"] == [0.0, 0.5 * (2.0 + 0.5 * 4.0)]
    assert (agent.state, agent.acc_reward) == ("b", 2.0)
    rule = EpsilonGreedy(initial_epsilon=0.4, min_epsilon=0.1, decay=0.5)
    space.seed(1)
    for expected in (0.2, 0.1, 0.1):
        rule.choose({"s": [0.0, 1.0]}, "s", space)
        assert rule.epsilon == pytest.approx(expected)
    rule.reset()
    assert rule.epsilon == 0.4
    assert {EpsilonGreedy(0.0).choose({"s": [0.0, 1.0]}, "s", space) for _ in range(20)} == {1}
    assert {EpsilonGreedy(1.0, 1.0).choose({"s": [0.0, 1.0]}, "s", space) for _ in range(20)} == {
        0,
        1,
    }


@pytest.mark.filterwarnings(f"ignore:{NAMED.pattern}")
def test_both_environments_for_pettingzoo_pass_its_api_tests(routes: str) -> None:
    arguments = {"net_file": str(NET), "route_file": routes, "num_seconds": 50}
    with closing(sumo_rl.env(**arguments)) as env:
        api_test(env, num_cycles=200)
    with closing(sumo_rl.parallel_env(**arguments)) as env:
        parallel_api_test(env, num_cycles=30)


def test_both_environments_for_pettingzoo_give_equal_results(routes: str) -> None:
    arguments: dict[str, Any] = {"net_file": str(NET), "route_file": routes, "num_seconds": 100}
    with (
        closing(grid(routes, sumo_seed=5)) as env,
        closing(sumo_rl.parallel_env(sumo_seed=5, **arguments)) as parallel,
        closing(sumo_rl.env(sumo_seed=5, **arguments)) as aec,
    ):
        env.reset()
        parallel.reset()
        aec.reset()
        assert parallel.unwrapped.env.sim_max_time == 100
        for k in range(20):
            actions = {ts: k // 3 % env.action_spaces(ts).n for ts in env.ts_ids}
            expected, rewards, dones, info = env.step(actions)
            seen, given, terminated, truncated, infos = parallel.step(actions)
            for ts in env.ts_ids:
                aec.step(actions[ts])
            for ts in env.ts_ids:
                np.testing.assert_array_equal(seen[ts], expected[ts])
                np.testing.assert_array_equal(aec.observe(ts), expected[ts])
                assert given[ts] == aec.rewards[ts] == rewards[ts]
                assert not terminated[ts]
                assert truncated[ts] == aec.truncations[ts] == dones["__all__"]
                own = {name: info[name] for name in info if name.startswith((f"{ts}_", "system"))}
                assert infos[ts] == aec.infos[ts] == own
        assert not parallel.agents


# Environments of RESCO


def test_environments_of_resco_are_read_from_a_folder_of_the_user(
    routes: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, file in (("grid4x4", "grid4x4_1"), ("cologne1", "cologne1")):
        folder = tmp_path / "nets" / "RESCO" / name
        folder.mkdir(parents=True)
        shutil.copy(NET, folder / f"{name}.net.xml")
        shutil.copy(routes, folder / f"{file}.rou.xml")
    with closing(sumo_rl.grid4x4(nets=tmp_path / "nets")) as env:
        assert env.unwrapped.env.sim_max_time == 3600
        assert len(env.possible_agents) == 16
    monkeypatch.setenv("SUMO_RL_NETS", str(tmp_path / "nets" / "RESCO"))
    with closing(sumo_rl.cologne1(parallel=False, num_seconds=60)) as env:
        env.reset()
        assert env.unwrapped.env.sim_step == 25_200.0
        assert env.unwrapped.env.sim_max_time == 25_260
        assert env.agent_selection == "A0"


@pytest.mark.parametrize(
    "make",
    [
        sumo_rl.arterial4x4, sumo_rl.cologne1, sumo_rl.cologne3, sumo_rl.cologne8, sumo_rl.grid4x4,
        sumo_rl.ingolstadt1, sumo_rl.ingolstadt7, sumo_rl.ingolstadt21,
    ],
)  # fmt: skip
def test_the_error_for_missing_maps_names_the_argument_and_the_file(
    make: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("SUMO_RL_NETS", raising=False)
    with pytest.raises(ConfigError, match=r"not part of cavmarl; pass nets=FOLDER or set SUMO_RL"):
        make()
    with pytest.raises(ConfigError, match=rf"has no {make.__name__}/{make.__name__}\.net\.xml"):
        make(nets=tmp_path)


# Ignored and refused arguments


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("use_gui", True),
        ("virtual_display", (800, 600)),
        ("max_depart_delay", 0),
        ("waiting_time_memory", 500),
        ("time_to_teleport", 300),
        ("sumo_warnings", False),
    ],
)
def test_each_argument_without_an_effect_warns_once(routes: str, name: str, value: Any) -> None:
    with pytest.warns(UserWarning, match=rf"{name} = .* is ignored: ") as caught:
        grid(routes, **{name: value}).close()
    assert len(caught) == 1


@pytest.mark.parametrize(
    ("more", "error", "message"),
    [
        ({"net_file": "no.net.xml"}, MapError, "net_file = 'no.net.xml': no such file"),
        ({"route_file": "no.rou.xml"}, DemandError, "route_file = 'no.rou.xml': no such file"),
        ({"delta_time": 2}, ConfigError, "delta_time = 2: must be above yellow_time = 2"),
        ({"num_seconds": 0}, ConfigError, "num_seconds = 0: must be above 0"),
        ({"yellow_time": -1}, ConfigError, "signals.yellow_s"),
        ({"min_green": 5.05}, ConfigError, "min_green_s.*whole number of ticks"),
        ({"reward_fn": "speed"}, ConfigError, "reward_fn = 'speed': must be a function"),
        ({"reward_fn": {"A0": "queue"}}, ConfigError, "reward_fn: 'A1' has no reward"),
        ({"sumo_seed": "seven"}, ConfigError, "sumo_seed = 'seven': must be a whole number"),
        ({"additional_sumo_cmd": "--wings 2"}, ConfigError, "'--wings' is not an option of SUMO"),
        ({"additional_sumo_cmd": "-n other"}, ConfigError, "no such file|is set by another"),
        ({"additional_sumo_cmd": "-b 7"}, ConfigError, "begin is set by another argument"),
        ({"render_mode": "ansi"}, ConfigError, "render_mode = 'ansi'"),
        ({"overrides": {"signals.wings": 1}}, ConfigError, "signals.wings"),
        ({"overrides": {"signals.sensing": "loops"}}, ConfigError, "must be truth: sumo-rl's"),
    ],
)
def test_invalid_arguments_are_refused(
    routes: str, more: dict[str, Any], error: type[CavmarlError], message: str
) -> None:
    given = {"net_file": str(NET), "route_file": routes, **more}
    with pytest.raises((error, DemandError), match=message):
        SumoEnvironment(**given)


def test_invalid_actions_are_refused(routes: str) -> None:
    with closing(grid(routes)) as env:
        env.reset()
        for actions, message in (
            ({"A0": 2}, "A0: the action is 2, must be from 0 to 1"),
            ({"A0": -1}, "A0: the action is -1"),
            ({"A0": 0.5}, "A0: the action is 0.5, must be a whole number"),
            ({"X9": 0}, "no signal 'X9' with two greens"),
            (1, "the actions are 1: must be a dict"),
        ):
            with pytest.raises(ActionError, match=re.escape(message)):
                env.step(actions)
        assert env.sim_step == 0.0
        env.step({"A0": np.int64(1), "A1": np.array([1])})


def test_access_to_traci_is_refused(routes: str) -> None:
    with closing(grid(routes)) as env:
        for owner in (env, env.traffic_signals["A0"]):
            assert not hasattr(owner, "sumo")
            with pytest.raises(ConfigError, match=r"there is no TraCI; read the methods of"):
                _ = owner.sumo
        with pytest.raises(AttributeError, match="no attribute 'wings'"):
            _ = env.wings


def test_the_world_can_be_drawn(routes: str) -> None:
    pytest.importorskip("pygame", reason="needs the extra: render")
    with closing(grid(routes, render_mode="rgb_array")) as env:
        env.reset()
        env.step({})
        picture = env.render()
        assert picture.dtype == np.uint8
        assert picture.ndim == 3
    with closing(grid(routes)) as env:
        assert env.render() is None
