"""The reward of an agent, from the named terms to its episode return.

| step | where it is computed | where it is called, at the end of each step |
|---|---|---|
| terms of one agent | `rewards/kernels/terms.py` | `sensors/kernels/sense.py`, in each shard |
| terms registered by users | `rewards/registered_terms.py` | `shards/registered_outputs.py` |
| weighted sum, team share | `rewards/kernels/reward.py` | `engine/kernels/outputs.py`, per world |
| credit to the return | `rewards/kernels/reward.py` | `shards/kernels/group_phases.py` |

The terms are computed inside `sense` because that kernel has filled the grid of vehicles around the
agent, which the time to collision needs. `engine/tick.py` has the order of these calls. Evaluation
reads the same terms.
"""
