"""Count what makes code hard to follow: methods, attributes, parameters and lines."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias

ROOT = Path(__file__).resolve().parents[2]
Function: TypeAlias = ast.FunctionDef | ast.AsyncFunctionDef

_KERNELS = {"kernel", "inlined_kernel", "inlined_function"}
_PROPERTIES = {"property", "cached_property"}


class PackageCode:
    """The syntax trees of the package."""

    def __init__(self, folder: Path = ROOT / "cavmarl") -> None:
        self._paths = sorted(folder.rglob("*.py"))
        texts = {path: path.read_text(encoding="utf-8") for path in self._paths}
        self._lines = {_module_of(path, folder): text.count("\n") for path, text in texts.items()}
        self._trees = {_module_of(path, folder): ast.parse(text) for path, text in texts.items()}
        self._classes: dict[str, list[ast.ClassDef]] = defaultdict(list)
        for tree in self._trees.values():
            for node in ast.walk(tree):
                if isinstance(node, ast.ClassDef):
                    self._classes[node.name].append(node)

    @property
    def lines(self) -> int:
        """Return the number of lines of all files."""
        return sum(self._lines.values())

    def classes(self) -> Iterator[tuple[str, ast.ClassDef]]:
        """Yield each top-level class with its full name."""
        for module, tree in self._trees.items():
            for node in tree.body:
                if isinstance(node, ast.ClassDef):
                    yield f"{module}.{node.name}", node

    def public_methods(self, node: ast.ClassDef) -> set[str]:
        """Return the public methods of a class and its bases; properties are not counted."""
        return {
            function.name
            for part in self._with_bases(node)
            for function in part.body
            if isinstance(function, Function)
            and not function.name.startswith("_")
            and not _decorators(function) & _PROPERTIES
        }

    def attributes(self, node: ast.ClassDef) -> set[str]:
        """Return the attributes that methods of a class and its bases set on `self`."""
        return {
            target.attr
            for part in self._with_bases(node)
            for target in ast.walk(part)
            if isinstance(target, ast.Attribute)
            and isinstance(target.ctx, ast.Store)
            and isinstance(target.value, ast.Name)
            and target.value.id == "self"
        }

    def functions(self) -> Iterator[tuple[str, Function, bool]]:
        """Yield each function and method outside of cavmarl.cli, and whether it has a `self`."""
        for module, tree in self._trees.items():
            if not module.startswith("cavmarl.cli"):
                yield from _functions_of(tree.body, module, is_class=False)

    def reachable_lines(self, start: list[str]) -> int:
        """Return the lines of all modules that some modules import, directly or indirectly."""
        seen: set[str] = set()
        waiting = list(start)
        while waiting:
            name = waiting.pop()
            while name not in self._trees and "." in name:
                name = name.rpartition(".")[0]
            if name in seen or name not in self._trees:
                continue
            seen.add(name)
            if "." in name:
                waiting.append(name.rpartition(".")[0])
            waiting += _imports(self._trees[name])
        return sum(self._lines[name] for name in seen)

    def _with_bases(self, node: ast.ClassDef) -> Iterator[ast.ClassDef]:
        yield node
        for base in node.bases:
            name = base.value if isinstance(base, ast.Subscript) else base
            found = self._classes.get(name.id, []) if isinstance(name, ast.Name) else []
            if len(found) == 1 and found[0] is not node:
                yield from self._with_bases(found[0])


def counted_parameters(function: Function, is_method: bool) -> int:
    """Return the number of parameters that a caller must distinguish.

    Keyword-only parameters of public functions and parameters of kernels do not count.
    """
    if _decorators(function) & _KERNELS:
        return 0
    arguments = function.args
    count = len(arguments.posonlyargs) + len(arguments.args) - is_method
    is_private = function.name.startswith("_") and function.name != "__init__"
    return count + len(arguments.kwonlyargs) * is_private


def has_untyped_arguments(function: Function) -> bool:
    """Return whether a function takes untyped `*arguments`; a `ParamSpec` counts as typed."""
    given = function.args.vararg
    if given is None or function.name == "__exit__":
        return False
    kind = "" if given.annotation is None else ast.unparse(given.annotation)
    return kind in ("", "Any", "object")


def _module_of(path: Path, folder: Path) -> str:
    parts = path.relative_to(folder.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _decorators(function: Function) -> set[str]:
    return {name.id for name in function.decorator_list if isinstance(name, ast.Name)}


def _functions_of(
    body: list[ast.stmt], name: str, is_class: bool
) -> Iterator[tuple[str, Function, bool]]:
    for node in body:
        if isinstance(node, ast.ClassDef):
            yield from _functions_of(node.body, f"{name}.{node.name}", is_class=True)
        elif isinstance(node, Function):
            has_self = is_class and "staticmethod" not in _decorators(node)
            yield f"{name}.{node.name}", node, has_self
            yield from _functions_of(node.body, f"{name}.{node.name}", is_class=False)


def _imports(tree: ast.Module) -> Iterator[str]:
    """Yield the names that the top level of a module imports."""
    for node in tree.body:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
