"""Scenarios: one file per scenario, in this folder or elsewhere.

The docstring of a file describes the scenario. The file defines

- `NEEDS`, a description of the map that the scenario needs;
- `Parameters`, a frozen dataclass of `scene.setting`s and `scene.switch`es;
- `places(streets, parameters)`, the possible places on a map by name;
- `stage(streets, place, parameters)`, the `Scene` at one of these places.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from difflib import get_close_matches
from functools import cache, lru_cache
from pathlib import Path
from pkgutil import iter_modules
from types import ModuleType
from typing import Any

import numpy as np

from cavmarl.config.scenario import ScenarioConfig, path_of_code
from cavmarl.core.errors import ConfigError, ScenarioError
from cavmarl.core.math.rng import STREAM_PLACE, below, world_key
from cavmarl.core.scene_names import is_scene_file
from cavmarl.core.tracebacks import fault_in
from cavmarl.roads.network import RoadNetwork
from cavmarl.traffic.scenarios.logged_traffic import plan_logged_scene
from cavmarl.traffic.scenarios.scene import Scene, checked
from cavmarl.traffic.scenarios.streets import Streets

PARTS = ("NEEDS", "Parameters", "places", "stage")


def scenario_names() -> list[str]:
    """Return the names of the scenarios that come with cavmarl, sorted."""
    return sorted(module.name for module in iter_modules(__path__))


@cache
def load_scenario(name: str) -> Any:
    """Load the module of a scenario.

    Args:
        name: one of `scenario_names`, or the path of a `.py` file.

    Raises:
        ConfigError: the name is unknown, or the file does not define a scenario.
    """
    if name in scenario_names():
        return importlib.import_module(f"{__name__}.{name}")
    path = path_of_code(name)
    if path is None or not path.is_file():
        close = get_close_matches(name, scenario_names(), n=1)
        hint = f"did you mean {close[0]}? " if close else ""
        raise ConfigError(
            f"no scenario or file '{name}'; {hint}Choose one of: {', '.join(scenario_names())}"
        )
    module = _run(path)
    if missing := [part for part in PARTS if not hasattr(module, part)]:
        raise ConfigError(f"{path}: this is not a scenario; define {', '.join(missing)}")
    return module


def _run(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"cavmarl_scenario_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ConfigError(f"{path}: this is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses resolve their annotations in this module
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # the user's file may raise any exception
        del sys.modules[spec.name]
        raise ConfigError(fault_in(path, error)) from error
    return module


def summary_of(name: str) -> str:
    """Return the first paragraph of a scenario's docstring."""
    text = load_scenario(name).__doc__ or ""
    return " ".join(text.strip().split("\n\n")[0].split())


def plan_scene(config: ScenarioConfig, network: RoadNetwork, agents: int = 1) -> Scene | None:
    """Return the scene for a map; None without a scenario.

    `agents`: number of agents; a logged scene has a seat for each agent.

    Raises ConfigError: the scenario or the place does not exist, or a parameter is unknown or out
    of range; ScenarioError: the map has no place for the scenario; MapError: the file of a logged
    scene cannot be read.
    """
    if not config.name:
        return None
    if is_scene_file(config.name):
        return plan_logged_scene(config, network, agents)
    scenario = load_scenario(config.name)
    parameters = checked(scenario.Parameters, config.params, config.name)
    places = _places(config.name, network, parameters)
    if not places:
        raise ScenarioError(
            f"scenario '{config.name}': the map '{network.name}' has no place for it; it needs "
            f"{scenario.NEEDS}"
        )
    name = config.place
    if not name:
        key = np.uint64(world_key(config.seed, 0, 0))
        name = sorted(places)[below(key, 0, 0, STREAM_PLACE, len(places))]
    if name not in places:
        close = get_close_matches(name, places, n=1)
        some = ", ".join(close or sorted(places)[:5])
        raise ConfigError(
            f"scenario.place = {name!r}: not one of the {len(places)} places that the map "
            f"'{network.name}' has for '{config.name}', such as {some}"
        )
    scene: Scene = scenario.stage(Streets(network), places[name], parameters)
    return scene


@lru_cache(maxsize=16)  # the worlds of an environment call it one after the other
def _places(name: str, network: RoadNetwork, parameters: Any) -> dict[str, Any]:
    found: dict[str, Any] = load_scenario(name).places(Streets(network), parameters)
    return found
