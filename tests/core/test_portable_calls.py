"""Code whose results enter a world calls no function that differs between processors."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "cavmarl"
FOLDERS = """
    core roads maps driving zones traffic v2x rewards sensors ownership shards handoff engine
    env policies config
""".split()
# These files do not compute worlds. The folders compare maps with scans and write files for other
# programs. The two files exchange frames with CARLA, whose states are compared with a tolerance.
OTHER = (
    "maps/fidelity/",
    "maps/exports/",
    "handoff/simulators/carla_zone_client.py",
    "handoff/simulators/carla_frames.py",
)
# These files are in other folders. They compute tables of results, or are drivers.
FILES = ("evaluate/*.py", "evaluate/scenarios/criticality.py", "../agents/*.py")

# Functions of the C library or NumPy whose rounding depends on the processor.
UNSAFE = set(
    """
    sin cos tan asin acos atan atan2 arcsin arccos arctan arctan2 sinh cosh tanh asinh acosh atanh
    arcsinh arccosh arctanh exp exp2 expm1 log log2 log10 log1p logaddexp pow power float_power cbrt
    hypot dist erf erfc gamma lgamma angle sinc NormalDist gauss normalvariate
    dot vdot inner outer matmul tensordot einsum linalg convolve correlate polyfit cov corrcoef
    """.split()
)
MODULES = {"math", "np", "numpy", "cmath", "statistics"}

EXCEPTIONS = {
    "evaluate/plots.py: np.hypot": "drawn",
    "handoff/coordinator/violations.py: math.hypot": "in the text of an error",
    "maps/buildings.py: math.dist": "compared with a tolerance that is far above rounding",
    "sensors/mounted/mount_transforms.py: @": "for programs that show sensors, not for worlds",
    "sensors/sensed_shapes.py: math.atan2": "drawn by viewers",
    "sensors/sensed_shapes.py: np.cos": "drawn by viewers",
    "sensors/sensed_shapes.py: np.sin": "drawn by viewers",
}


def unsafe_calls(tree: ast.AST) -> Iterator[str]:
    """Yield the functions, matrix products and powers whose results depend on the processor."""
    for node in ast.walk(tree):
        match node:
            case ast.Attribute(value=ast.Name(id=module), attr=name) if module in MODULES:
                if name in UNSAFE:
                    yield f"{module}.{name}"
            case ast.ImportFrom(module=module) if module in MODULES:
                yield from (f"{module}.{each.name}" for each in node.names if each.name in UNSAFE)
            case ast.Attribute(attr="dot"):
                yield ".dot"
            case ast.BinOp(op=ast.MatMult()):
                yield "@"
            case ast.BinOp(op=ast.Pow(), right=right):
                # NumPy squares exactly; other powers come from the C library.
                is_number = isinstance(node.left, ast.Constant) and isinstance(right, ast.Constant)
                if not is_number and not (isinstance(right, ast.Constant) and right.value == 2):
                    yield "**"


def found_calls() -> set[str]:
    """Return `file: call` of each unsafe call in code whose results enter a world."""
    paths = [path for folder in FOLDERS for path in (PACKAGE / folder).rglob("*.py")]
    paths += [path for pattern in (*FILES, "**/kernels/**/*.py") for path in PACKAGE.glob(pattern)]
    assert len(paths) > 300
    return {
        f"{name}: {call}"
        for path in paths
        if not (name := path.as_posix().removeprefix(f"{PACKAGE}/")).startswith(OTHER)
        for call in unsafe_calls(ast.parse(path.read_bytes()))
    }


def test_worlds_are_computed_with_functions_that_are_equal_on_all_processors() -> None:
    new = found_calls() - set(EXCEPTIONS)
    assert not new, f"use cavmarl.core.math.elementary or elementary_arrays: {sorted(new)}"


def test_every_exception_names_a_call_that_exists() -> None:
    assert set(EXCEPTIONS) <= found_calls()


@pytest.mark.parametrize(
    ("text", "call"),
    [
        ("math.sin(x)", "math.sin"),
        ("y = np.hypot(*d)", "np.hypot"),
        ("from math import atan2", "math.atan2"),
        ("a @ b", "@"),
        ("x ** 3", "**"),
        ("10.0 ** x", "**"),
        ("np.linalg.inv(a)", "np.linalg"),
        ("a.dot(b)", ".dot"),
    ],
)
def test_unsafe_calls_are_found(text: str, call: str) -> None:
    assert list(unsafe_calls(ast.parse(text))) == [call]


@pytest.mark.parametrize("text", ["math.sqrt(x)", "x ** 2", "10**12", "np.floor(x)", "sine(x)"])
def test_exact_operations_are_allowed(text: str) -> None:
    assert not list(unsafe_calls(ast.parse(text)))
