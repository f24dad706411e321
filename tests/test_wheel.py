"""The wheel: its content, and its use outside of the checkout."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import pytest

from cavmarl.config.registry import agent_entries, entries

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (found,) = folder.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def site(wheel: Path) -> Path:
    """Return a folder with the unpacked wheel."""
    zipfile.ZipFile(wheel).extractall(wheel.parent / "site")
    return wheel.parent / "site"


@pytest.fixture(scope="module")
def elsewhere(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the `bin` folder of a virtual environment with the installed wheel.

    It uses the dependencies of the present environment, so that no network is needed.
    """
    folder = tmp_path_factory.mktemp("elsewhere")
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    install = [str(folder / "bin" / "python"), "-m", "pip", "install", "--no-deps", "--no-index"]
    subprocess.run([*install, str(wheel)], check=True, capture_output=True)
    (packages,) = folder.glob("lib/python*/site-packages")
    borrowed = sysconfig.get_path("purelib")
    (packages / "borrowed.pth").write_text(f"{borrowed}\n", encoding="utf-8")
    return folder / "bin"


def room(cache: Path) -> dict[str, str]:
    """Return environment variables that set the folder of the cache."""
    return {"CAVMARL_CACHE_DIR": str(cache)}


def run(command: list[str], cwd: Path, settings: Mapping[str, str] = MappingProxyType({})) -> str:
    """Run a command without access to the checkout; return its output."""
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        command, cwd=cwd, env=clean | settings, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


# Make imports of the compiler and of torch fail.
BARE = """
import sys
for name in ("numba", "llvmlite", "torch"):
    sys.modules[name] = None
"""
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
def test_every_environment_runs_from_an_installed_wheel(elsewhere: Path, tmp_path: Path) -> None:
    out = run([str(elsewhere / "python"), "-c", BARE + DRIVE], tmp_path)
    place, departed = json.loads(out)
    assert place.startswith(str(elsewhere.parent))
    assert list(departed) == list(entries())
    assert min(departed.values()) > 1


EVERYTHING = """
import cavmarl

def drive(**keys):
    vec = cavmarl.make_vec("grid4x4", num_envs=2, agents=4, background=40, **keys)
    policy = cavmarl.load_policy("idm", vec)
    observations, infos = vec.reset(seed=1)
    for _ in range(5):
        actions = policy.act_batch(observations, infos["mask"])
        observations, *_, infos = vec.step(actions)
    vec.close()

if __name__ == "__main__":
    drive(zones=4)
    drive(zones=4, workers=2)
    drive(zones=4, nodes=2)
    drive(overrides={"rig": "ten_sensors"})
    drive(overrides={"v2x.enabled": True, "sensors.messages.objects": 4})
    drive(overrides={"sensors.lidar.rays": 16, "sensors.way.lines": 2, "sensors.stack": 2})
    print("driven")
"""
PREBUILT = {"CAVMARL_KERNELS": "prebuilt"}


@pytest.mark.slow
def test_an_installed_wheel_has_all_kernels_for_zones_workers_nodes_and_sensors(
    elsewhere: Path, tmp_path: Path
) -> None:
    script = tmp_path / "everything.py"
    script.write_text(BARE + EVERYTHING)
    cache = tmp_path / "cache"
    told = run([str(elsewhere / "python"), str(script)], tmp_path, PREBUILT | room(cache))
    assert told.split() == ["driven"]
    assert not list(cache.rglob("*.kernel"))


@pytest.mark.slow
def test_a_trained_driver_of_an_installed_wheel_needs_neither_compiler_nor_torch(
    elsewhere: Path, tmp_path: Path
) -> None:
    code = BARE + "from cavmarl.cli import main; sys.exit(main(sys.argv[1:]))"
    words = ["evaluate", "merge", "--policy", "merge_ippo", "--episodes", "1", "--out", "result"]
    run([str(elsewhere / "python"), "-c", code, *words], tmp_path, PREBUILT)
    assert (tmp_path / "result" / "trips.csv").is_file()


@pytest.mark.slow
def test_a_read_only_installation_works_without_a_cache(elsewhere: Path, tmp_path: Path) -> None:
    command = [
        str(elsewhere / "python"),
        "-c",
        BARE + DRIVE.replace("cavmarl.entries()", "['ring']"),
    ]
    run(command, tmp_path, PREBUILT | room(Path("/proc/cavmarl")))


@pytest.mark.slow
def test_a_damaged_library_is_reported_and_replaced_by_compiled_kernels(
    site: Path, tmp_path: Path
) -> None:
    damaged = tmp_path / "site"
    shutil.copytree(site, damaged)
    library = damaged / "cavmarl/core/compiled/prebuilt/kernels.so"
    content = bytearray(library.read_bytes())
    content[len(content) // 2] ^= 1
    library.write_bytes(content)
    code = "from cavmarl.core.math.bearings import rough_atan2; print(rough_atan2(1.0, 2.0))"
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=damaged, env=os.environ | room(tmp_path / "cache"), capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    assert 0.4 < float(done.stdout) < 0.5
    assert f"{library} is damaged: install cavmarl again" in done.stderr


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
def test_the_wheel_has_all_files_of_the_data_folders(site: Path, kind: str) -> None:
    assert files(site / "cavmarl" / "data" / kind) == files(ROOT / kind)


@pytest.mark.slow
def test_an_installed_wheel_finds_its_own_entries(site: Path) -> None:
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
    """Return the relative paths of all files in a folder, without Python's caches."""
    return {
        path.relative_to(folder)
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
