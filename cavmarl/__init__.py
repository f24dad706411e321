"""Multi-agent reinforcement learning for connected and automated vehicles on real road networks.

    import cavmarl
    env = cavmarl.parallel_env("town", agents=25, background=100, seed=0)   # PettingZoo ParallelEnv
    vec = cavmarl.make_vec("merge", num_envs=16)                            # batched arrays
    policy = cavmarl.load_policy("idm", env)
"""

from cavmarl.vector_env import CavVectorEnv, make_vec
from cavmarl.env import CavEnv, parallel_env
