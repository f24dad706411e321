"""`kernel_calls.json`: each kernel that Python calls, with the argument types of these calls.

The file is recorded: programs and tests run with `CAVMARL_KERNEL_CALLS`, and what they have called
is merged (`python -m cavmarl.prebuild record FOLDER`). Bundles that occur in many calls are written
once.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Iterable, Mapping, Set
from pathlib import Path
from typing import Any, NamedTuple

MANIFEST = Path(__file__).with_name("kernel_calls.json")
_READONLY = " readonly"
_BUNDLE = "#"  # before the number of a bundle


class KernelCall(NamedTuple):
    """A kernel and one list of argument types, see `core.compiled.signatures`."""

    name: str
    signature: str  # as JSON
    is_plain: bool = False  # needed until the end of the first step of a plain world

    @property
    def kinds(self) -> list[Any]:
        """The argument types."""
        kinds: list[Any] = json.loads(self.signature)
        return kinds


def read_manifest(path: Path = MANIFEST) -> list[KernelCall]:
    """Return all calls of the file."""
    if not path.exists():
        return []  # nothing has been recorded yet
    document = json.loads(path.read_text("utf-8"))
    bundles: list[Any] = []
    for bundle in document["bundles"]:  # each may contain earlier ones
        bundles.append(_expand(bundle, bundles))
    return [
        KernelCall(name, json.dumps(_expand(kinds, bundles)), is_plain)
        for name, calls in document["kernels"].items()
        for is_plain, kinds in calls
    ]


def write_manifest(calls: Iterable[KernelCall], path: Path = MANIFEST) -> None:
    """Write calls in an order that does not depend on how they were found."""
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
    """Return what processes have recorded in a folder."""
    found = set()
    for path in folder.glob("*.jsonl"):
        for line in path.read_text("utf-8").splitlines():
            name, kinds = json.loads(line)
            found.add(KernelCall(name, json.dumps(kinds)))
    return found


def merged(calls: Iterable[KernelCall]) -> set[KernelCall]:
    """Return one call in the place of several that differ in arrays that are read only.

    Code for an array that is read only takes others, too; see `arguments.accepts`.
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
    """Return the calls, marked by whether plain worlds make them."""
    unmarked = {call._replace(is_plain=False) for call in calls}
    return {call._replace(is_plain=call in plain) for call in unmarked}


def _fold(kind: Any, bundles: dict[str, int]) -> Any:
    """Replace each bundle by its number; `bundles` gets those that are new."""
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
