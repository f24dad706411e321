"""Find references to missing names and files in docstrings and comments of the package."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from cavmarl.config.env import EnvConfig
from cavmarl.config.io import dotted_keys

ROOT = Path(__file__).resolve().parents[2]

# First parts of dotted names that are not of the package: libraries and classes of highway-env.
OTHERS = frozenset(
    """
    copy defusedxml dtype flags gymnasium httpx numba numpy ray select socket sumolib time
    IDMVehicle TimeLimit Vehicle utils
    """.split()
)
LOGGERS = frozenset(["cavmarl.workers"])

_DOTTED = re.compile(r"`([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)+)(?:\([^`]*\))?`")
_FILE = re.compile(r"`([\w./-]+\.py)`")
_DOCSTRING = re.compile(r'"""(.*?)"""', re.DOTALL)
_COMMENT = re.compile(r"#\s(.*)")
_DATA = (
    "html",
    "json",
    "jsonl",
    "parquet",
    "safetensors",
    "xml",
    "yaml",
    "zst",
)  # suffixes of file names


class _Members:
    """The names of the members of a class, and its bases."""

    def __init__(self, node: ast.ClassDef) -> None:
        self.bases = [base.id for base in node.bases if isinstance(base, ast.Name)]
        self.names = set(_defined(node.body))
        for part in ast.walk(node):
            if isinstance(part, ast.Attribute) and isinstance(part.ctx, ast.Store):
                self.names.add(part.attr)


def _defined(body: list[ast.stmt]) -> Iterator[str]:
    """Yield the names that statements define or import, including statements under an `if`."""
    for node in body:
        match node:
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                yield node.name
            case ast.Assign():
                targets = [part for target in node.targets for part in ast.walk(target)]
                yield from (part.id for part in targets if isinstance(part, ast.Name))
            case ast.AnnAssign(target=ast.Name(id=name)):
                yield name
            case ast.Import() | ast.ImportFrom():
                yield from ((alias.asname or alias.name).split(".")[0] for alias in node.names)
            case ast.If():
                yield from _defined(node.body)


def _annotated(tree: ast.Module) -> dict[str, set[str]]:
    """Return the classes in annotations of parameters and fields of a module, by name."""
    found: dict[str, set[str]] = defaultdict(set)
    for node in ast.walk(tree):
        if isinstance(node, ast.arg) and node.annotation is not None:
            name, annotation = node.arg, node.annotation
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            name, annotation = node.target.id, node.annotation
        else:
            continue
        found[name] |= {part.id for part in ast.walk(annotation) if isinstance(part, ast.Name)}
    return found


class Package:
    """The modules, classes and keys that a docstring can refer to."""

    def __init__(self) -> None:
        self.sources: dict[str, str] = {}
        self._classes: dict[str, list[_Members]] = defaultdict(list)
        self._modules: dict[str, list[str]] = defaultdict(
            list
        )  # last part of a module name → full names
        self._keys = dotted_keys(EnvConfig)
        trees: dict[str, ast.Module] = {}
        for path in sorted((ROOT / "cavmarl").rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            text = self.sources[name] = path.read_text(encoding="utf-8")
            tree = trees[name] = ast.parse(text)
            self._modules[name.rpartition(".")[2]].append(name)
            for node in tree.body:
                if isinstance(node, ast.ClassDef):
                    self._classes[node.name].append(_Members(node))
        self._tops = {name: set(_defined(tree.body)) for name, tree in trees.items()}

    def dead(self) -> list[str]:
        """Return the module and the text of each dead reference."""
        return [
            f"{module}: `{name}`"
            for module, source in self.sources.items()
            for name in self.dead_in(source)
        ]

    def dead_in(self, source: str) -> Iterator[str]:
        """Yield each missing name and file that docstrings and comments of a source refer to."""
        text = "\n".join([*_DOCSTRING.findall(source), *_COMMENT.findall(source)])
        for name in _FILE.findall(text):
            if "NAME" not in name and not self._is_file(name):
                yield name
        for name in _DOTTED.findall(text):
            parts = name.split(".")
            if parts[-1] == "py" or parts[-1] in _DATA or parts[0] in OTHERS or name in LOGGERS:
                continue
            if self._is_key(name) or self._is_name(parts):
                continue
            holders = _annotated(ast.parse(source)).get(parts[0], set())
            if not any(self._has(holder, parts[1]) for holder in holders):
                yield name

    def _is_file(self, name: str) -> bool:
        if "/" in name:
            return (ROOT / name).is_file() or (ROOT / "cavmarl" / name).is_file()
        return name.removesuffix(".py") in self._modules

    def _is_key(self, name: str) -> bool:
        """Return whether a name is a key or section of `env.yaml`, or the end of a key."""
        return any(
            f".{key}.".find(f".{name}.") >= 0 or name.startswith(f"{key}.") for key in self._keys
        )

    def _is_name(self, parts: list[str]) -> bool:
        """Return whether a dotted name means a module, a name in a module, or a class member."""
        if self._has(parts[0], parts[1]):
            return True
        for size in range(1, len(parts) + 1):
            for module in self._modules[parts[size - 1]]:
                if module.split(".")[-size:] == parts[:size] and self._is_in(module, parts[size:]):
                    return True
        return False

    def _is_in(self, module: str, names: list[str]) -> bool:
        if not names:
            return True
        is_top = names[0] in self._tops[module]
        return is_top and (len(names) == 1 or self._has(names[0], names[1]))

    def _has(self, class_name: str, attribute: str) -> bool:
        return any(
            attribute in members.names or any(self._has(base, attribute) for base in members.bases)
            for members in self._classes.get(class_name, ())
        )
