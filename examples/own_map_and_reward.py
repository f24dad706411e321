"""Your own map and reward. `own_map_and_reward.ipynb` is the same program as a notebook."""

# %% [markdown]
# # Your own map and reward
# You can drive on any SUMO network, and on files of OpenStreetMap and OpenDRIVE. Here, netconvert
# builds a bend from two small files; the extra `sumo` installs it.

# %%
import os
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import sumo

import cavmarl

SHORT = bool(os.environ.get("CAVMARL_SHORT"))  # a short run for the tests

folder = Path(tempfile.mkdtemp(prefix="cavmarl-"))
(folder / "bend.nod.xml").write_text(
    '<nodes><node id="a" x="0" y="0"/><node id="b" x="200" y="0"/>'
    '<node id="c" x="300" y="150"/></nodes>'
)
(folder / "bend.edg.xml").write_text(
    '<edges><edge id="in" from="a" to="b" numLanes="2" speed="13.89"/>'
    '<edge id="out" from="b" to="c" numLanes="2" speed="13.89"/></edges>'
)
subprocess.run(
    [
        str(Path(sumo.SUMO_HOME) / "bin" / "netconvert"),
        f"--node-files={folder / 'bend.nod.xml'}",
        f"--edge-files={folder / 'bend.edg.xml'}",
        f"--output-file={folder / 'bend.net.xml'}",
    ],
    check=True,
    capture_output=True,
)

# %% [markdown]
# A reward term is a function of an agent's surroundings. `reach_m` is the distance within which it
# uses other vehicles.


# %%
def smooth(view: cavmarl.AgentView) -> float:
    """Return the lateral acceleration, divided by 3 m/s²."""
    return abs(float(view.own["speed"] * view.own["yaw_rate"])) / 3.0


cavmarl.register_term("smooth", smooth, reach_m=0.0)
env = cavmarl.parallel_env(
    str(folder / "bend.net.xml"),
    agents=3,
    background=5,
    seed=0,
    max_cycles=30 if SHORT else 300,
    overrides={
        "terms.weights": {"progress": 0.1, "collision": -10, "off_road": -10, "smooth": -0.2}
    },
)

# %% [markdown]
# The infos contain each term of the step by name, before it is multiplied by its weight.

# %%
observations, infos = env.reset()
sums = {"progress": 0.0, "smooth": 0.0}
while env.agents:
    observations, rewards, terminations, truncations, infos = env.step(env.suggest_actions())
    for info in infos.values():
        for name in sums:
            sums[name] += info[name]
print({name: round(float(np.float64(total)), 2) for name, total in sums.items()})
env.close()
