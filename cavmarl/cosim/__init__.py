"""Lock-step with other processes: the time master, followers over a socket, a reference stack.

Depends on `env`; `cli` starts both ends.
"""
