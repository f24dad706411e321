"""The kernels that Python calls. They are entry points; other kernels are compiled into them."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import TypeGuard

_PACKAGE = Path(__file__).parents[1]
_DECORATORS = {"kernel", "inlined_kernel"}
# Functions and classes that make kernels, or collect kernels for other kernels.
_FACTORIES = {"for_each_zone", "acceleration_model", "CarFollowingModel"}
_CORE = ("core.math", "core.records")  # packages of kernels that are not named `kernels`


def called_kernels() -> frozenset[str]:
    """Return the names of all kernels that modules of the package call from Python.

    A kernel counts as called if a module outside of the folders of kernels imports or defines it,
    or if a function in its own file that is not a kernel calls it (such as
    `roads.kernels.plans.plan_goal`).
    """
    trees = {_module_of(path): ast.parse(path.read_bytes()) for path in _PACKAGE.rglob("*.py")}
    defined = {module: set(_defined(tree)) for module, tree in trees.items()}
    found: set[str] = set()
    for module, tree in trees.items():
        if not _is_of_kernels(module):
            found |= {f"{module}.{name}" for name in defined[module]}
            found |= {
                f"{source}.{name}"
                for source, name in _imported(tree)
                if name in defined.get(source, ())
            }
        else:
            found |= {f"{module}.{name}" for name in _called_by_plain(tree, defined[module])}
    return frozenset(found)


def _module_of(path: Path) -> str:
    parts = path.relative_to(_PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _is_of_kernels(module: str) -> bool:
    return ".kernels." in f"{module}." or any(f"cavmarl.{core}." in module for core in _CORE)


def _is_kernel(function: ast.FunctionDef) -> bool:
    return any(
        isinstance(name, ast.Name) and name.id in _DECORATORS for name in function.decorator_list
    )


def _functions(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    return (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))


def _defined(tree: ast.Module) -> Iterator[str]:
    yield from (function.name for function in _functions(tree) if _is_kernel(function))
    for statement in tree.body:
        if _is_made(statement):
            yield from (name.id for name in statement.targets if isinstance(name, ast.Name))


def _is_made(statement: ast.stmt) -> TypeGuard[ast.Assign]:
    """Return whether a statement assigns the result of a factory to a name."""
    return (
        isinstance(statement, ast.Assign)
        and isinstance(statement.value, ast.Call)
        and isinstance(statement.value.func, ast.Name)
        and statement.value.func.id in _FACTORIES
    )


def _imported(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Yield (module, name) of each name that a file imports, or uses from an imported module."""
    modules: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for alias in node.names:
                yield node.module, alias.name
                modules[alias.asname or alias.name] = f"{node.module}.{alias.name}"
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if node.value.id in modules:
                yield modules[node.value.id], node.attr


def _called_by_plain(tree: ast.Module, kernels: set[str]) -> Iterator[str]:
    """Yield kernels that a file uses outside of kernels and factories."""
    for statement in tree.body:
        is_of_kernels = _is_made(statement) or (
            isinstance(statement, ast.FunctionDef)
            and (_is_kernel(statement) or statement.name in _FACTORIES)
        )
        if not is_of_kernels:
            for node in ast.walk(statement):
                if isinstance(node, ast.Name) and node.id in kernels:
                    yield node.id
