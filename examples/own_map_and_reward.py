"""An own map and an own reward. `own_map_and_reward.ipynb` is the same as a notebook."""

# %% [markdown]
# # An own map and an own reward
#
# Any SUMO network is a world; so are files of OpenStreetMap and OpenDRIVE. Here a bend is made of
# two small files with netconvert, which the extra `sumo` brings.

# %%
import os
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import sumo

import cavmarl

SHORT = bool(os.environ.get("CAVMARL_SHORT"))  # as the tests run it

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
# A term is a function of what an agent has around it. `reach_m` says how far it looks.


# %%
def smooth(view: cavmarl.AgentView) -> float:
    """How hard the vehicle is pushed to the side, over 3 m/s²."""
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
# The infos have each term of the step by its name, before it is weighed.

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
