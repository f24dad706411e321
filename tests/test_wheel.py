"""A wheel works away from the checkout: it carries the data folders."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from cavmarl.registry import agent_entries, entries

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the content of a fresh wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    zipfile.ZipFile(wheel).extractall(folder / "site")
    return folder / "site"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["envs", "agents", "configs"])
def test_a_wheel_carries_the_data_folders_whole(site: Path, kind: str) -> None:
    assert files(site / "cavmarl" / "data" / kind) == files(ROOT / kind)


@pytest.mark.slow
def test_a_wheel_finds_its_own_entries(site: Path) -> None:
    code = (
        "import json; from cavmarl.registry import *; "
        "maps = [str(resolve_map(*load_config(name))) for name in entries()]; "
        "print(json.dumps([[*entries()], [*agent_entries()], maps]))"
    )
    command = [sys.executable, "-c", code]
    out = subprocess.run(command, cwd=site, check=True, capture_output=True, text=True)
    environments, agents, maps = json.loads(out.stdout)
    assert environments == list(entries())
    assert agents == list(agent_entries())
    assert str(site / "cavmarl/data/envs/ring/map/map.net.xml") in maps


def files(folder: Path) -> set[Path]:
    """All files below a folder, relative to it, without Python's caches."""
    return {
        path.relative_to(folder)
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
