"""A wheel works away from the checkout: it carries the data folders."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

from cavmarl.config.registry import agent_entries, entries

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (found,) = folder.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def site(wheel: Path) -> Path:
    """A folder with the content of the wheel."""
    zipfile.ZipFile(wheel).extractall(wheel.parent / "site")
    return wheel.parent / "site"


@pytest.fixture(scope="module")
def elsewhere(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The `bin` of an environment of its own that the wheel is installed in.

    What the wheel depends on is borrowed from here: a test must not need a network.
    """
    folder = tmp_path_factory.mktemp("elsewhere")
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    install = [str(folder / "bin" / "python"), "-m", "pip", "install", "--no-deps", "--no-index"]
    subprocess.run([*install, str(wheel)], check=True, capture_output=True)
    (packages,) = folder.glob("lib/python*/site-packages")
    borrowed = sysconfig.get_path("purelib")
    (packages / "borrowed.pth").write_text(f"{borrowed}\n", encoding="utf-8")
    return folder / "bin"


def run(command: list[str], cwd: Path) -> str:
    """What a command says that knows nothing of the checkout."""
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, cwd=cwd, env=clean, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


DRIVE = """
import json, cavmarl
steps = {}
for name in cavmarl.entries():
    env = cavmarl.parallel_env(name, seed=0)
    policy = cavmarl.load_policy("idm", env)
    observations, _ = env.reset()
    for _ in range(20):
        observations, *_ = env.step(policy.act(observations))
    vec = cavmarl.make_vec(name, num_envs=2, seed=0)
    vec.reset()
    vec.step(vec.suggest_actions())
    steps[name] = env.traffic_stats()["departed"]
print(json.dumps([cavmarl.__file__, steps]))
"""


@pytest.mark.slow
def test_every_environment_drives_from_an_installed_wheel(elsewhere: Path, tmp_path: Path) -> None:
    out = run([str(elsewhere / "python"), "-c", DRIVE], tmp_path)
    place, departed = json.loads(out)
    assert place.startswith(str(elsewhere.parent))
    assert list(departed) == list(entries())
    assert min(departed.values()) > 1


@pytest.mark.slow
def test_the_installed_command_runs(elsewhere: Path, tmp_path: Path) -> None:
    out = run([str(elsewhere / "cavmarl"), "list"], tmp_path)
    for name in [*entries(), *agent_entries()]:
        assert name in out


@pytest.mark.slow
def test_an_installed_wheel_trains(elsewhere: Path, tmp_path: Path) -> None:
    command = [str(elsewhere / "cavmarl"), "train", "ppo", "--config", "merge"]
    small = {"agents": 2, "background": 0, "num-envs": 2, "num-steps": 8, "minibatches": 2}
    words = [f"--{key}={value}" for key, value in {**small, "total-agent-steps": 40}.items()]
    assert "driver:" in run([*command, *words, "--name", "tiny"], tmp_path)
    assert (tmp_path / "runs" / "tiny" / "model.safetensors").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["envs", "agents", "configs", "train"])
def test_a_wheel_carries_the_data_folders_whole(site: Path, kind: str) -> None:
    assert files(site / "cavmarl" / "data" / kind) == files(ROOT / kind)


@pytest.mark.slow
def test_a_wheel_finds_its_own_entries(site: Path) -> None:
    code = (
        "import json; from cavmarl.config.registry import *; "
        "maps = [str(m) for name in entries() for m in resolve_maps(*load_config(name))]; "
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
