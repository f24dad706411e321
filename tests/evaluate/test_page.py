"""The HTML page of results, in a real browser."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

from cavmarl.core.errors import ManifestError
from cavmarl.evaluate import evaluate, load_report
from cavmarl.evaluate.page import write_page

SMALL: dict[str, Any] = {"episodes": 2, "agents": 3, "background": 3, "max_cycles": 80}
QUIET = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--hide-scrollbars",
)  # fmt: skip
# When the page is loaded, this script writes the state of the browser into the page.
PROBE = """<script>
window.addEventListener("load", () => {
  const size = element => {
    const box = element.getBoundingClientRect();
    return [box.width, box.height];
  };
  const told = {
    errors: window.told_errors,
    svgs: [...document.querySelectorAll("figure svg")].map(size),
    rows: Object.fromEntries([...document.querySelectorAll("table")].map(
      table => [table.id, table.tBodies[0].rows.length])),
    empty: [...document.querySelectorAll("td.mean")].filter(cell => !cell.innerText.trim()).length,
    wide: document.documentElement.scrollWidth,
    loaded: performance.getEntriesByType("resource").map(entry => entry.name),
    texts: [...document.querySelectorAll("svg text")].length,
  };
  const out = document.createElement("pre");
  out.id = "told";
  out.textContent = JSON.stringify(told);
  document.body.append(out);
});
</script>"""
EARLY = """<script>
window.told_errors = [];
window.addEventListener("error", event => window.told_errors.push(event.message), true);
</script>"""

Browse = Callable[..., str]


@pytest.fixture(scope="session")
def browse(tmp_path_factory: pytest.TempPathFactory) -> Browse:
    """Return `browse(path, *switches)`, which opens a page and returns the browser's output."""
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no chromium: apt-get install chromium")

    def run(page: Path, *switches: str) -> str:
        profile = f"--user-data-dir={tmp_path_factory.mktemp('profile')}"
        command = [program, *QUIET, profile, "--window-size=1280,3000", *switches, page.as_uri()]
        done = subprocess.run(command, capture_output=True, check=True, timeout=120)
        return done.stdout.decode()

    return run


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the results of two policies in two runs."""
    path = tmp_path_factory.mktemp("results") / "found"
    policies = {"built in": "idm", "<b>chance</b>": "random_actions"}
    evaluate("merge", policies, repeats=2, out=path, **SMALL)
    return path


@pytest.fixture(scope="module")
def page(folder: Path) -> Path:
    path = folder.parent / "page.html"
    write_page(folder, path)
    return path


@pytest.fixture(scope="module")
def told(page: Path, browse: Browse) -> dict[str, Any]:
    """Return the state of the page in the browser."""
    text = page.read_text(encoding="utf-8")
    probed = page.with_name("probed.html")
    probed.write_text(
        text.replace("<head>", f"<head>{EARLY}").replace("</body>", f"{PROBE}</body>"),
        encoding="utf-8",
    )
    found = re.search(r'<pre id="told">(.*?)</pre>', browse(probed, "--dump-dom"), re.DOTALL)
    assert found, "the browser did not reach the end of the page"
    document: dict[str, Any] = json.loads(found[1])
    return document


def test_a_browser_shows_the_page_without_errors_and_loads_no_other_file(
    told: dict[str, Any],
) -> None:
    assert told["errors"] == []
    assert told["loaded"] == []


def test_the_tables_of_the_page_are_filled(told: dict[str, Any]) -> None:
    assert {"results", "differences", "rewards", "runs"} == told["rows"].keys()
    assert told["rows"]["results"] > 12
    assert min(told["rows"].values()) >= 3
    assert told["empty"] == 0


def test_the_pictures_of_the_page_have_a_size_and_text(told: dict[str, Any]) -> None:
    assert len(told["svgs"]) == 3 + 2  # the plots, and one map per policy
    assert all(width > 600 and height > 60 for width, height in told["svgs"])
    assert told["texts"] > 40


def test_the_page_fits_the_screen(told: dict[str, Any]) -> None:
    assert told["wide"] <= 1280


def test_screenshots_of_the_page_can_be_taken(page: Path, browse: Browse, tmp_path: Path) -> None:
    shot = tmp_path / "page.png"
    browse(page, f"--screenshot={shot}")
    assert shot.stat().st_size > 50_000


def test_the_page_shows_the_figures_and_the_manifest(folder: Path, page: Path) -> None:
    text, report = page.read_text(encoding="utf-8"), load_report(folder)
    success = report["built in"]["success"].mean
    assert success is not None
    assert f"{100.0 * success:.2f}" in text
    assert report.manifest["hardware"]["cpu"] in text
    assert report.manifest["world"]["map_content_sha256"] in text
    assert "95 % between runs" in text


def test_names_are_text_and_not_markup(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert "<b>chance</b>" not in text
    assert "&lt;b&gt;chance" in text


def test_the_ids_of_the_page_are_unique(page: Path) -> None:
    ids: list[str] = []

    class Ids(HTMLParser):
        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            ids.extend(value or "" for name, value in attrs if name == "id" and tag != "path")

    Ids().feed(page.read_text(encoding="utf-8"))
    doubled = {name for name in ids if ids.count(name) > 1}
    assert not {name for name in doubled if "_" in name}


def test_the_page_of_one_run_states_that_there_is_no_interval(tmp_path: Path) -> None:
    evaluate("merge", "idm", out=tmp_path / "one", **SMALL)
    write_page(tmp_path / "one", tmp_path / "one.html")
    assert "no interval between runs" in (tmp_path / "one.html").read_text(encoding="utf-8")


def test_a_divided_world_shows_the_changes_of_zone(page: Path, tmp_path: Path) -> None:
    small = {**SMALL, "background": 40, "overrides": {"zones.count": 4}}
    found = evaluate("grid4x4", "idm", out=tmp_path / "four", **small)["idm"].transfers
    assert found is not None
    assert found.transfers > 0
    write_page(tmp_path / "four", tmp_path / "four.html")
    text = (tmp_path / "four.html").read_text(encoding="utf-8")
    (block,) = re.findall(r'<table id="transfers">(.*?)</table>', text, re.DOTALL)
    shown = dict(re.findall(r'<td title=".*?">(.*?)</td><td class="mean">(.*?)</td>', block))
    assert shown["changes"] == f"{found.transfers:,}"
    assert shown["forced"] == str(found.forced)
    depths = (found.switch_depth_m, found.release_depth_m)
    for name, spread in zip(("SWITCH", "RELEASE"), depths, strict=True):
        cell = " / ".join(f"{value:.2f}" for value in spread if value is not None)
        assert shown[f"depth at {name} <small>m</small>"] == cell
    assert "zone imbalance" in text
    assert 'id="transfers"' not in page.read_text(encoding="utf-8"), (
        "the page shows transfers of the undivided world"
    )


def test_a_page_of_results_without_a_manifest_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ManifestError):
        write_page(tmp_path, tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()
