"""Lock-step with other processes: the time master, followers over a socket, a reference stack.

Stands on `env`; `cli` starts its two ends.
"""
