"""axe-core finds no accessibility fault on the light and dark pages in a real browser."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cavmarl.evaluate import evaluate
from cavmarl.viewer.web_options import WebOptions
from tests.support.chromium import until
from tests.viewer.conftest import Served

Serve = Callable[..., Served]


@pytest.fixture(scope="module")
def axe() -> str:
    """Return the script of axe-core from a Python package."""
    found = importlib.util.find_spec("axe_playwright_python")
    if found is None or not found.submodule_search_locations:
        pytest.skip("axe-playwright-python is not installed")
    return (Path(found.submodule_search_locations[0]) / "axe.min.js").read_text(encoding="utf-8")


def violations(page: Any, axe: str) -> list[str]:
    """Return the violated rules of axe with the elements that violate them."""
    page.evaluate(axe)
    found = page.evaluate("axe.run(document)")
    assert len(found["passes"]) > 10
    return [
        f"{one['id']} ({one['impact']}): {', '.join(node['html'][:120] for node in one['nodes'])}"
        for one in found["violations"]
    ]


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_axe_finds_no_fault_of_the_page(browser: Any, serve: Serve, axe: str, theme: str) -> None:
    served = serve(insertions=4)
    page = browser.new_page(viewport={"width": 1280, "height": 760}, color_scheme=theme)
    page.goto(served.server.address)
    until(page, "window.viewer && viewer.frame && viewer.firstPicture")
    page.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    page.fill("#wanted", "car_1")
    page.press("#wanted", "Enter")
    until(page, "document.querySelector('#observation').rows.length > 5")
    page.click("#insert")  # shows a notice
    assert violations(page, axe) == []
    page.set_viewport_size({"width": 360, "height": 640})
    assert violations(page, axe) == []


def test_axe_finds_no_fault_of_the_token_form(browser: Any, serve: Serve, axe: str) -> None:
    served = serve(options=WebOptions(port=0, token="open sesame"))
    page = browser.new_page()
    page.goto(served.server.address)
    page.wait_for_selector("#token-box[open]")
    assert violations(page, axe) == []


def test_axe_finds_no_fault_of_the_page_of_failed_trips(
    browser: Any, axe: str, tmp_path: Path
) -> None:
    evaluate("merge", "random_actions", episodes=1, out=tmp_path / "out", failures=3)
    page = browser.new_page()
    page.goto((tmp_path / "out" / "failures.html").as_uri())
    until(page, "document.body.dataset.ready")
    assert violations(page, axe) == []
