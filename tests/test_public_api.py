"""Public names, and the duration of `import cavmarl`."""

from __future__ import annotations

import json
import subprocess
import sys
import types
from pathlib import Path

import pytest

import cavmarl

ROOT = Path(__file__).resolve().parents[1]

LATE = (
    "numba", "torch", "stable_baselines3", "highway_env", "libsumo", "sumolib", "sumo", "pydantic",
    "pygame", "imageio", "matplotlib", "jinja2", "typer", "rich", "fastapi", "ray", "psutil",
    "torchrl", "tensordict", "benchmarl", "pyarrow", "mcap",
)  # fmt: skip

PROBE = """
import json, sys, time
start = time.process_time()
import gymnasium, numpy, pettingzoo
between = time.process_time()
import cavmarl
share = (time.process_time() - between) / (between - start)
print(json.dumps([share, sorted(name.split(".")[0] for name in sys.modules)]))
"""


@pytest.fixture(scope="module")
def imported() -> tuple[float, set[str]]:
    """Return the cost of `import cavmarl` without its libraries, and the imported packages.

    The cost is the least processor time of three new processes, in s.
    """
    runs = []
    for _ in range(3):
        done = subprocess.run(
            [sys.executable, "-c", PROBE], cwd=ROOT, check=True, capture_output=True, text=True
        )
        runs.append(json.loads(done.stdout))
    return min(share for share, _ in runs), set(runs[0][1])


def test_the_import_is_quick(imported: tuple[float, set[str]]) -> None:
    assert imported[0] < 1.0


@pytest.mark.parametrize("package", LATE)
def test_import_cavmarl_does_not_import_optional_and_heavy_packages(
    imported: tuple[float, set[str]], package: str
) -> None:
    assert package not in imported[1]


def test_all_is_sorted_and_its_names_exist() -> None:
    constants, classes = str.isupper, str.istitle
    assert cavmarl.__all__ == sorted(
        cavmarl.__all__, key=lambda name: (not constants(name), not classes(name[0]), name)
    )
    ours = {
        name
        for name, value in vars(cavmarl).items()
        if getattr(value, "__module__", "cavmarl").startswith("cavmarl")
    }
    late = {"parallel_env", "env", "raw_env", "make_vec", "load_policy"}
    public = {name for name in ours | late if not name.startswith("_")} - {"TYPE_CHECKING"}
    public -= {name for name in public if isinstance(getattr(cavmarl, name), types.ModuleType)}
    assert set(dir(cavmarl)) >= public
    for name in cavmarl.__all__:
        assert getattr(cavmarl, name) is not None


def test_the_function_env_is_not_hidden_by_the_folder_env() -> None:
    probe = (
        "import pickle, cavmarl, cavmarl.env.vector\n"
        "assert callable(cavmarl.env), cavmarl.env\n"
        "assert pickle.loads(pickle.dumps(cavmarl)) is cavmarl\n"
    )
    subprocess.run([sys.executable, "-c", probe], cwd=ROOT, check=True)


def test_the_functions_of_the_readme_exist() -> None:
    for name in ("parallel_env", "env", "raw_env", "make_vec", "load_policy"):
        assert name in cavmarl.__all__
        assert callable(getattr(cavmarl, name))
        assert getattr(cavmarl, name).__doc__


def test_every_public_error_has_the_base_class_of_cavmarl() -> None:
    errors = [
        value
        for name in cavmarl.__all__
        if isinstance(value := getattr(cavmarl, name), type) and issubclass(value, Exception)
    ]
    assert len(errors) > 10
    assert all(issubclass(error, cavmarl.CavmarlError) for error in errors)
