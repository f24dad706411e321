"""Every folder of `envs/` is complete: a card, a configuration, a map."""

from __future__ import annotations

import gzip
import importlib.metadata
import re
import subprocess
import sys
from pathlib import Path

import pytest

from cavmarl.config.env import EnvConfig
from cavmarl.config.registry import load_config, resolve_maps
from cavmarl.core.errors import MissingExtraError
from cavmarl.maps.check import check_map
from tests.support.generated import check_block, table

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = sorted(path for path in (ROOT / "envs").iterdir() if path.is_dir())
RECIPES = sorted((ROOT / "envs").glob("*/map/*.net*cfg"))

each_folder = pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)


@each_folder
def test_the_folder_has_the_name_of_its_environment(folder: Path) -> None:
    config, base_dir = load_config(folder.name)
    assert config.name == folder.name
    assert base_dir.samefile(folder)


@each_folder
def test_the_map_can_be_driven_and_has_the_configured_edges(folder: Path) -> None:
    config, base_dir = load_config(folder.name)
    map_paths = maps_or_skip(config, base_dir)
    assert all(check_map(path).drivable for path in map_paths)
    text = read(map_paths[0])
    for edge in (*config.traffic.origins, *config.traffic.destinations):
        assert f'<edge id="{edge}"' in text


@each_folder
def test_the_card_agrees_with_the_configuration(folder: Path) -> None:
    config, base_dir = load_config(folder.name)
    card = folder / "README.md"
    check_block(card, "facts", facts(config, maps_or_skip(config, base_dir)))
    text = card.read_text(encoding="utf-8")
    assert f'cavmarl.parallel_env("{config.name}")' in text
    assert re.search(rf"## Versions\n\n- {config.version}: ", text), (
        "the card does not begin with this version"
    )


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda recipe: "/".join(recipe.parts[-3::2]))
def test_a_generated_map_equals_the_result_of_its_options(recipe: Path, tmp_path: Path) -> None:
    pinned = re.search(
        r"^eclipse-sumo==(.*)$", (ROOT / "constraints/exact.txt").read_text(), re.MULTILINE
    )
    assert pinned
    try:
        installed = importlib.metadata.version("eclipse-sumo")
    except importlib.metadata.PackageNotFoundError:
        pytest.skip("eclipse-sumo is not installed")
    if installed != pinned[1]:
        pytest.skip(f"maps were made by eclipse-sumo {pinned[1]}, here is {installed}")
    program = {".netccfg": "netconvert", ".netgcfg": "netgenerate"}[recipe.suffix]
    built = tmp_path / "map.net.xml"
    options = ("--configuration-file", recipe.name, "--output-file", str(built))
    subprocess.run(
        [sys.executable, "-c", f"import sumo; sumo.{program}()", *options],
        cwd=recipe.parent,
        check=True,
        capture_output=True,
    )
    # The comment at the top has date, version and options.
    text = re.sub(
        r"\n<!-- generated on .*?\n-->\n", "", built.read_text(), count=1, flags=re.DOTALL
    )
    (made,) = recipe.parent.glob(f"{recipe.stem}.net.xml*")
    assert text == read(made)


def read(path: Path) -> str:
    data = path.read_bytes()
    return (gzip.decompress(data) if path.suffix == ".gz" else data).decode()


def maps_or_skip(config: EnvConfig, base_dir: Path) -> list[Path]:
    try:
        return resolve_maps(config, base_dir)
    except MissingExtraError as error:
        pytest.skip(str(error))


def facts(config: EnvConfig, map_paths: list[Path]) -> str:
    """Return the table of facts of a card."""
    reports = [check_map(path) for path in map_paths]
    people, clock = config.population, config.clock
    budget = f", {people.num_ids} in an episode" if people.mode == "open" else ""
    trip = f"from {config.traffic.min_trip_m:g} m"
    if config.traffic.max_trip_m:
        trip += f" to {config.traffic.max_trip_m:g} m"
    weights = (f"`{name}` {weight:g}" for name, weight in config.terms.weights.items())
    rows = (
        ("map", ", ".join(f"`{source}`" for source in config.map.sources)),
        (
            "roads",
            f"{sum(report.road_km for report in reports):.2f} km, "
            f"{sum(report.lanes for report in reports)} lanes, "
            f"{sum(report.signals for report in reports)} traffic lights",
        ),
        ("population", f"`{people.mode}`: {people.agents} agents{budget}"),
        ("background", f"{people.background} vehicles"),
        ("trips", trip),
        ("horizon", f"{config.horizon_s:g} s = {config.max_steps} steps"),
        ("step", f"{clock.ctrl_dt_s:g} s = {clock.ticks_per_step} ticks of {clock.sim_dt_s:g} s"),
        ("action", f"`{config.action.kind}`"),
        ("observation", f"`{config.observation.kind}`"),
        ("terms · weights", ", ".join(weights)),
        ("team share", f"{config.terms.team_share:g}"),
    )
    return table(("fact", "value"), rows)
