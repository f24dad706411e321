"""Actions of trained drivers do not depend on the number of worlds, the interface or torch."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cavmarl.env.parallel import parallel_env
from cavmarl.env.vector import make_vec
from cavmarl.evaluate.evaluation import evaluate, load_tables
from cavmarl.policies.loading import load_policy

STEPS = 60


@pytest.mark.parametrize("driver", ["merge_ippo", "merge_ippo+idm", "shielded:merge_ippo"])
def test_an_episode_does_not_depend_on_the_number_of_parallel_episodes(
    driver: str, tmp_path: Path
) -> None:
    first = []
    for episodes in (1, 2, 4):
        out = tmp_path / str(episodes)
        evaluate("merge", driver, episodes=episodes, out=out, agents=6, seed=987, max_cycles=150)
        trips, _ = load_tables(out)[driver]
        first.append(trips[trips["episode"] == 0])
    assert len(first[0]) >= 6
    assert first[0].tobytes() == first[1].tobytes() == first[2].tobytes()


@pytest.mark.parametrize("driver", ["merge_ippo", "merge_ippo+merge_ippo", "shielded:merge_ippo"])
def test_dicts_and_batches_give_the_same_actions(driver: str) -> None:
    world = {"agents": 5, "background": 4}
    env = parallel_env("merge", **world)  # type: ignore[arg-type]
    vec = make_vec("merge", num_envs=3, **world)  # type: ignore[arg-type]
    one, many = load_policy(driver, env), load_policy(driver, vec)
    seen, _ = env.reset(seed=5)
    observations, infos = vec.reset(seed=5)
    for _ in range(STEPS):
        by_agent = one.act(seen)
        actions = many.act_batch(observations, infos["mask"])
        for k, agent in enumerate(env.possible_agents):
            if agent in by_agent:
                np.testing.assert_array_equal(by_agent[agent], actions[0, k])
        seen, *_ = env.step(by_agent)
        observations, _, _, _, infos = vec.step(actions)
    env.close()
    vec.close()


def test_each_driver_of_a_shared_policy_acts_as_if_it_were_alone() -> None:
    vec = make_vec("merge", num_envs=3, agents=5, background=4)
    observations, infos = vec.reset(seed=5)
    names = ("merge_ippo+idm", "merge_ippo", "idm")
    shared, trained, idm = (load_policy(name, vec) for name in names)
    is_even = np.arange(5) % 2 == 0
    for _ in range(STEPS):
        mask = infos["mask"]
        found = shared.act_batch(observations, mask)
        own, other = trained.act_batch(observations, mask), idm.act_batch(observations, mask)
        np.testing.assert_array_equal(found[mask & is_even], own[mask & is_even])
        np.testing.assert_array_equal(found[mask & ~is_even], other[mask & ~is_even])
        observations, _, _, _, infos = vec.step(found)
    vec.close()


def test_a_trained_driver_is_evaluated_without_torch() -> None:
    """Loading a scripted driver does not import safetensors."""
    code = (
        "import sys\n"
        "class NoTorch:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.partition('.')[0] == 'torch':\n"
        "            sys.exit('torch is imported')\n"
        "sys.meta_path.insert(0, NoTorch())\n"
        "from cavmarl import load_policy, make_vec\n"
        "load_policy('idm', make_vec('merge'))\n"
        "print('safetensors' in sys.modules)\n"
        "from cavmarl.cli import main\n"
        "main(['evaluate', 'merge', '--policy', 'merge_ippo', '--episodes', '1'])"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.startswith("False\n")
    assert "merge_ippo" in ran.stdout
