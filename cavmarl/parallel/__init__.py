"""Many worlds with autoreset, in this process, in worker processes, or on other machines.

Stands on `engine` and `balance`; `env` is its caller.
"""
