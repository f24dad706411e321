"""The sources of compiled kernels: a kernel's code is valid for the content of these files.

Numba only watches the file that defines a function. But a kernel's code includes the kernels that
it calls, so its digest covers all files of kernels that its file imports, directly or indirectly.
"""

from __future__ import annotations

import hashlib
import re
from functools import cache
from pathlib import Path

# Imports of one file of kernels by another; a test checks that imports have no other form.
IMPORT_LINE = re.compile(rb"^from cavmarl\.([\w.]+) import ", re.MULTILINE)
_PACKAGE = Path(__file__).parents[2]
_COMPILED = "core.compiled"
# Files of that folder that affect the code of all kernels; the other files only call it.
COMPILER_FILES = tuple(f"{_COMPILED}.{name}" for name in ("arguments", "compiler", "entry_point"))
_PARTS = (*COMPILER_FILES, f"{_COMPILED}.prefetch", f"{_COMPILED}.run_calls")


@cache
def kernel_sources() -> dict[str, bytes]:
    """Return the content of each file of kernels, by its dotted name in the package."""
    folders = (
        *_PACKAGE.rglob("kernels"),
        _PACKAGE / "core" / "math",
        _PACKAGE / "core" / "records",
    )
    paths = [path for folder in folders for path in folder.rglob("*.py")]
    paths += [_PACKAGE.joinpath(*name.split(".")).with_suffix(".py") for name in _PARTS]
    return {_name_of(path): path.read_bytes() for path in paths}


@cache
def sources_digest() -> str:
    """Return a digest of all kernel sources."""
    return _digest_of(kernel_sources())


@cache
def module_digest(module: str) -> str:
    """Return the digest of the sources of a module's kernels.

    For a module outside of the package, this is the digest of all kernel sources; `kernel_files`
    adds the content of the module's own file.
    """
    sources = kernel_sources()
    name = module.removeprefix("cavmarl.")
    if name not in sources:
        return sources_digest()
    found, to_read = set(COMPILER_FILES), [name]
    while to_read:
        name = to_read.pop()
        if name not in found:
            found.add(name)
            imported = [other.decode() for other in IMPORT_LINE.findall(sources[name])]
            to_read += [
                other for other in imported if other in _PARTS or not other.startswith(_COMPILED)
            ]
    return _digest_of({name: sources[name] for name in found})


def _name_of(path: Path) -> str:
    parts = path.relative_to(_PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _digest_of(sources: dict[str, bytes]) -> str:
    digest = hashlib.sha256()
    for name, content in sorted(sources.items()):
        digest.update(f"{name}.py".encode() + b"\0" + content)
    return digest.hexdigest()[:16]
