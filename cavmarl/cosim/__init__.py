"""Lock-step with other processes: the time master, followers, a reference stack, CARLA's clients.

Depends on `env`; `cli` starts both ends.
"""
