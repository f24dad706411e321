"""`kernel_calls.json`: each kernel that Python calls, with the argument types of these calls.

Programs and tests that run with `CAVMARL_KERNEL_CALLS` record their calls, and `python -m
cavmarl.prebuild record FOLDER` merges them into the file. A bundle (a named tuple of arguments)
that occurs in several calls is written once.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import json
from collections.abc import Iterable, Mapping, Set
from pathlib import Path
from typing import Any, NamedTuple

from cavmarl.core.compiled.signatures import example_arguments, signature_of

MANIFEST = Path(__file__).with_name("kernel_calls.json")
_READONLY = " readonly"
_BUNDLE = "#"  # precedes the number of a bundle


class KernelCall(NamedTuple):
    """A kernel and one list of argument types; see `core.compiled.signatures`."""

    name: str
    signature: str  # as JSON
    is_plain: bool = False  # whether a first step in `PLAIN_WORLDS` makes this call

    @property
    def kinds(self) -> list[Any]:
        """The argument types."""
        kinds: list[Any] = json.loads(self.signature)
        return kinds


def read_manifest(path: Path = MANIFEST) -> list[KernelCall]:
    """Return all calls in the file."""
    if not path.exists():
        return []  # no calls have been recorded yet
    document = json.loads(path.read_text("utf-8"))
    bundles: list[Any] = []
    for bundle in document["bundles"]:  # a bundle may contain earlier bundles
        bundles.append(_expand(bundle, bundles))
    return [
        KernelCall(name, json.dumps(_expand(kinds, bundles)), is_plain)
        for name, calls in document["kernels"].items()
        for is_plain, kinds in calls
    ]


def write_manifest(calls: Iterable[KernelCall], path: Path = MANIFEST) -> None:
    """Write calls in an order that does not depend on their input order."""
    bundles: dict[str, int] = {}
    kernels: dict[str, list[Any]] = {}
    for call in sorted(set(calls)):
        row = [int(call.is_plain), _fold(call.kinds, bundles)]
        kernels.setdefault(call.name, []).append(row)
    lines = [
        '{"bundles": [',
        ",\n".join(bundles),
        '], "kernels": {',
        ",\n".join(
            f"{json.dumps(name)}: [\n" + ",\n".join(map(json.dumps, found)) + "]"
            for name, found in kernels.items()
        ),
        "}}",
    ]
    path.write_text("\n".join(lines) + "\n", "utf-8")


def recorded_calls(folder: Path) -> set[KernelCall]:
    """Return the calls that processes have recorded in a folder."""
    found = set()
    for path in folder.glob("*.jsonl"):
        for line in path.read_text("utf-8").splitlines():
            name, kinds = json.loads(line)
            found.add(KernelCall(name, json.dumps(kinds)))
    return found


def can_be_made(call: KernelCall) -> bool:
    """Return whether a kernel accepts these arguments, and their types are up to date."""
    module, _, name = call.name.rpartition(".")
    try:
        kernel = getattr(importlib.import_module(module), name)
        takes = [str(one.annotation) for one in inspect.signature(kernel).parameters.values()]
        return (
            len(takes) == len(call.kinds)
            and all(map(_fits, takes, call.kinds))
            and signature_of(example_arguments(call.kinds)) == call.kinds
        )
    except (ImportError, AttributeError, TypeError):
        return False


def _fits(annotation: str, kind: Any) -> bool:
    """Return whether a parameter may accept an argument; only bundles are checked."""
    is_bundle = isinstance(kind, dict) and "bundle" in kind
    is_named = annotation != str(inspect.Parameter.empty)
    return not (is_bundle and is_named) or kind["bundle"].rpartition(":")[2] in annotation


def merged(calls: Iterable[KernelCall]) -> set[KernelCall]:
    """Merge calls that differ only in which arrays are read-only.

    Code for a read-only array also accepts other arrays; see `arguments.accepts`.
    """
    groups: dict[tuple[str, str], list[KernelCall]] = {}
    for call in calls:
        shape = call.signature.replace(_READONLY, "")
        groups.setdefault((call.name, shape), []).append(call)
    return {
        KernelCall(
            name,
            json.dumps(functools.reduce(_merge, (call.kinds for call in group))),
            any(call.is_plain for call in group),
        )
        for (name, _), group in groups.items()
    }


def _merge(one: Any, other: Any) -> Any:
    if isinstance(one, list):
        return [_merge(*pair) for pair in zip(one, other, strict=True)]
    if isinstance(one, Mapping):
        return {key: _merge(value, other[key]) for key, value in one.items()}
    return other if isinstance(other, str) and _READONLY in other else one


def marked(calls: Iterable[KernelCall], plain: Set[KernelCall]) -> set[KernelCall]:
    """Return the calls with `is_plain` set for calls in `plain`."""
    unmarked = {call._replace(is_plain=False) for call in calls}
    return {call._replace(is_plain=call in plain) for call in unmarked}


def _fold(kind: Any, bundles: dict[str, int]) -> Any:
    """Replace each bundle by its number, and add new bundles to `bundles`."""
    if isinstance(kind, list):
        return [_fold(item, bundles) for item in kind]
    if not isinstance(kind, Mapping):
        return kind
    folded = {key: _fold(value, bundles) for key, value in kind.items()}
    if "bundle" not in folded:
        return folded
    return f"{_BUNDLE}{bundles.setdefault(json.dumps(folded), len(bundles))}"


def _expand(kind: Any, bundles: list[Any]) -> Any:
    if isinstance(kind, str) and kind.startswith(_BUNDLE):
        return bundles[int(kind[len(_BUNDLE) :])]
    if isinstance(kind, list):
        return [_expand(item, bundles) for item in kind]
    if isinstance(kind, Mapping):
        return {key: _expand(value, bundles) for key, value in kind.items()}
    return kind
