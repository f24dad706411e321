"""The examples in the guide to scenarios work."""

from __future__ import annotations

import re
from pathlib import Path

from cavmarl.evaluate.scenarios.scenario_runs import make_scenario, run_scenario
from cavmarl.traffic.scenarios.library import scenario_names

PAGE = Path(__file__).resolve().parents[2] / "docs/guides/scenarios.md"


def blocks(name: str) -> list[str]:
    text = PAGE.read_text(encoding="utf-8")
    return re.findall(rf"<!-- {name} -->\n```python\n(.*?)```", text, re.DOTALL)


def test_the_page_names_all_scenarios() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE) != []
    assert set(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE)) == set(scenario_names())


def test_the_example_of_training_runs() -> None:
    (example,) = blocks("example")
    exec(compile(example, str(PAGE), "exec"), {})


def test_the_example_of_a_scenario_distinguishes_drivers(tmp_path: Path) -> None:
    (example,) = blocks("scenario")
    path = tmp_path / "van.py"
    path.write_text(example, encoding="utf-8")
    verdicts = {}
    for driver in ("idm", "never_yield"):
        vec = make_scenario(str(path))
        verdicts[driver] = run_scenario(vec, driver).verdict
    assert verdicts["never_yield"] == "collided"
    assert verdicts["idm"] != "collided"
