"""A first agent. `first_agent.ipynb` is the same program as a notebook."""

# %% [markdown]
# # A first agent
# Create a world by its name. `parallel_env` has PettingZoo's interface: dicts from agents to
# observations, actions and rewards.

# %%
import os

import numpy as np

import cavmarl

SHORT = bool(os.environ.get("CAVMARL_SHORT"))  # a short run for the tests

env = cavmarl.parallel_env(
    "merge", agents=4, background=10, seed=0, max_cycles=40 if SHORT else 400
)
observations, infos = env.reset()
print(env.agents, env.observation_space("car_0").shape, env.action_space("car_0"))

# %% [markdown]
# The [card](../envs/merge/README.md#observation) of `merge` lists the numbers of an observation.
# This driver uses a few of them. It steers to the middle of its lane, and keeps a speed below the
# limit and a time gap of 2 s to the vehicle ahead.


# %%
def drive(observation: np.ndarray) -> np.ndarray:
    """Return throttle and steering; the indices are those of the card."""
    speed, offset, error, limit = observation[[0, 4, 5, 6]] * [40.0, 4.0, np.pi, 40.0]
    gap_m = 10.0 / max(float(observation[91]), 1e-6) - 10.0  # gap to the vehicle ahead
    wanted = min(0.8 * limit, gap_m / 2.0)
    return np.clip([0.5 * (wanted - speed), -0.5 * offset - 4.0 * error], -1.0, 1.0).astype(
        np.float32
    )


returns = dict.fromkeys(env.agents, 0.0)
while env.agents:
    actions = {agent: drive(observations[agent]) for agent in env.agents}
    observations, rewards, terminations, truncations, infos = env.step(actions)
    for agent, reward in rewards.items():
        returns[agent] += reward
print({agent: round(total, 2) for agent, total in returns.items()})

# %% [markdown]
# Compare with the built-in driver. It reads the state of the world instead of observations.

# %%
observations, infos = env.reset(seed=0)
yardstick = 0.0
while env.agents:
    observations, rewards, terminations, truncations, infos = env.step(env.suggest_actions())
    yardstick += sum(rewards.values())
print(f"own driver {sum(returns.values()):.1f}, built-in driver {yardstick:.1f}")
env.close()
