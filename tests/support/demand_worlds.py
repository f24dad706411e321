"""Worlds with vehicles of demand files: tiny files on bundled maps, and real files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cavmarl.engine.simulation import Simulation
from tests.support.driving import make_simulation

# Short demands with all features of demand files: symbolic values of lane, position and speed,
# random types and routes, all kinds of flows, stops, and trips without a route.
MERGE = """<routes>
  <vType id="car" sigma="0.6" speedFactor="normc(1,0.1,0.8,1.2)"/>
  <vType id="idm" carFollowModel="IDM" length="4.2"/>
  <vType id="bus" vClass="bus"/>
  <vTypeDistribution id="some" vTypes="car idm" probabilities="3 1"/>
  <route id="straight" edges="main_in weave main_out"/>
  <flow id="main" type="some" route="straight" begin="0" end="90" period="2.5"
        departLane="free" departPos="base" departSpeed="max"/>
  <flow id="ramp" type="car" from="ramp" to="main_out" begin="0" end="90" period="exp(0.3)"
        departLane="best" departPos="last" departSpeed="avg"/>
  <flow id="rare" type="idm" from="ramp" to="main_out" begin="10" end="80" probability="0.1"
        departLane="random" departPos="random" departSpeed="random"/>
  <vehicle id="bus" type="bus" route="straight" depart="91" departLane="0">
    <stop lane="main_in_0" endPos="120" duration="8"/>
  </vehicle>
</routes>"""

GRID = """<routes>
  <vType id="car" sigma="0.4"/>
  <flow id="a" type="car" from="left0A0" to="D3right3" begin="0" end="60" period="4"
        departLane="best"/>
  <flow id="b" type="car" from="bottom1B0" to="C3top2" begin="0" end="60" period="exp(0.3)"
        departLane="free" departSpeed="desired"/>
  <flow id="c" type="car" from="right2D2" to="A1left1" begin="0" end="60" probability="0.25"
        departLane="allowed" departPos="random_free" departSpeed="speedLimit"/>
</routes>"""

TINY = {"merge": MERGE, "grid4x4": GRID}


def make(
    env: str | Path,
    files: Sequence[Path],
    *,
    num_worlds: int = 1,
    agents: int = 0,
    overrides: Mapping[str, Any] | None = None,
) -> Simulation:
    """Make worlds whose only vehicles are those of the files; the worlds are not reset."""
    wanted = {"traffic.demand": [str(path) for path in files], "horizon_s": 120.0}
    return make_simulation(
        env,
        mode="respawn",
        agents=agents,
        background=0,
        num_worlds=num_worlds,
        overrides=wanted | dict(overrides or {}),
    )


def tiny(env: str, folder: Path, **options: Any) -> Simulation:
    """Make worlds with the demand of an environment in `TINY`."""
    path = folder / f"{env}.rou.xml"
    path.write_text(TINY[env], encoding="utf-8")
    return make(env, [path], **options)


def real(name: str, maps: Path, **options: Any) -> Simulation:
    """Make worlds of Bologna or Mcity with their own demand, and with Bologna's signal programs."""
    folder = maps / "net" / {"bologna": "bologna_acosta", "mcity": "mcity"}[name]
    overrides = {"clock.sim_dt_s": 0.1, "clock.ctrl_dt_s": 0.5}
    if name == "mcity":
        files = [folder / "mcity.rou.xml", folder / "mcity.add.xml"]
        return make(folder / "mcity.net.xml", files, overrides=overrides, **options)
    overrides |= {"map.programs": [str(folder / "acosta_tls.add.xml")]}
    roads = folder / "acosta_buslanes.net.xml"
    return make(roads, [folder / "run.sumocfg"], overrides=overrides, **options)
