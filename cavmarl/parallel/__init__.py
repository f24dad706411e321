"""Many worlds with autoreset, in this process, in worker processes, or on other machines.

`backends` chooses where worlds run. `workers` runs them in processes of this machine, `nodes` in
processes on any machines. Imports go down only: backends, workers and nodes, placement, worlds,
sensor_workers, processes, state, memory and network.
"""
