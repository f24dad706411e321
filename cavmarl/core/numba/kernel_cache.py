"""Where compiled kernels are kept: by the content of their sources, wherever those lie.

Each file of kernels has a folder, named after its content and that of the files that it imports:
Numba itself only watches the file that defines a function, not the functions which that one calls,
and would use stale code. Checkouts and virtual environments with the same sources share a folder.
What is read back is compared with its checksum; a damaged file is compiled anew.
"""

from __future__ import annotations

import hashlib
import pickle
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
import numba.core.config
from numba.core import caching as numba_caching

from cavmarl.core.cache_folder import cache_dir, tell_unwritable

caching: Any = numba_caching  # has no types

# Every import of one file of kernels by another; a test holds that there is no other form of it.
_IMPORT = re.compile(rb"^from cavmarl\.([\w.]+) import ", re.MULTILINE)
_PACKAGE = Path(__file__).parents[2]
_SHARED = ("core.numba", "core.numba.compiler", "core.numba.kernel_cache")  # concern all kernels
_DIGEST_BYTES = 32


@cache
def kernel_cache_dir() -> Path:
    """The folder that stands for this version: one per content of all kernel sources.

    And one for those that check their indices (`NUMBA_BOUNDSCHECK=1`).
    """
    return _folder_of(_sources())


@cache
def _sources() -> dict[str, bytes]:
    """The content of each file of kernels, by its dotted name within the package."""
    core = (_PACKAGE / "core" / name for name in ("math", "numba", "records"))
    folders = (*_PACKAGE.rglob("kernels"), *core)
    return {_name_of(path): path.read_bytes() for folder in folders for path in folder.glob("*.py")}


def _name_of(path: Path) -> str:
    parts = path.relative_to(_PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def _cache_dir_of(module: str) -> Path:
    """Where the kernels of a module are kept; those of a module outside of this package, too."""
    sources = _sources()
    name = module.removeprefix("cavmarl.")
    if name not in sources:
        return kernel_cache_dir()
    found, to_read = set(_SHARED), [name]
    while to_read:
        name = to_read.pop()
        if name not in found:
            found.add(name)
            to_read += [other.decode() for other in _IMPORT.findall(sources[name])]
    return _folder_of({name: sources[name] for name in found})


def _folder_of(sources: dict[str, bytes]) -> Path:
    settings: Any = numba.core.config
    digest = hashlib.sha256(f"{numba.__version__} {settings.BOUNDSCHECK}".encode())
    for name, content in sorted(sources.items()):
        digest.update(f"{name}.py".encode() + b"\0" + content)
    return cache_dir() / "kernels" / digest.hexdigest()[:16]


class _Locator(caching._CacheLocator):  # type: ignore[misc]
    """Says to Numba where the kernels of a file are kept, and whether they are those of it."""

    def __init__(self, function: Any, file: str) -> None:
        self._file = file
        self._function = function

    @classmethod
    def from_function(cls, function: Any, file: str) -> _Locator:
        return cls(function, file)

    def get_cache_path(self) -> str:
        return str(_cache_dir_of(self._function.__module__))

    def get_source_stamp(self) -> str:
        """Kernels of this package: the folder says it; of a module outside, its own content."""
        if self._function.__module__.startswith("cavmarl."):
            return ""
        return hashlib.sha256(Path(self._file).read_bytes()).hexdigest()

    def get_disambiguator(self) -> str:
        line: int = self._function.__code__.co_firstlineno
        return f"{self._function.__module__}.{line}"


class _Impl(caching.CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes = (_Locator,)

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        """What was kept, to be called; to link it is an error of Numba's."""
        result = super().rebuild(target_context, payload)
        result.library._shared_module = None  # names alone, see `compiler._Whole`
        return result


class _CheckedFile(caching.IndexDataCacheFile):  # type: ignore[misc]
    """Numba's files of one kernel: an index with a checksum before it, which names data by theirs.

    Nothing is unpickled before its checksum is right. As a file of data is named by its content,
    processes that compile one kernel for different arguments at once overwrite none of each other.
    """

    def save(self, key: Any, data: Any) -> None:
        content = self._dump(data)
        name = f"{self._index_name.removesuffix('.nbi')}.{_digest(content).hex()[:32]}.nbc"
        with self._open_for_write(self._data_path(name)) as file:
            file.write(content)
        self._save_index({**self._load_index(), key: name})

    def _save_index(self, overloads: dict[Any, str]) -> None:
        content = self._dump((self._source_stamp, overloads))
        with self._open_for_write(self._index_path) as file:
            file.write(_digest(content) + content)

    def _load_index(self) -> dict[Any, str]:
        try:
            found = Path(self._index_path).read_bytes()
        except OSError:
            return {}
        content = found[_DIGEST_BYTES:]
        if _digest(content) != found[:_DIGEST_BYTES]:
            return {}
        stamp, overloads = pickle.loads(content)
        return overloads if stamp == self._source_stamp else {}

    def _load_data(self, name: str) -> Any:
        content = Path(self._data_path(name)).read_bytes()
        if _digest(content).hex()[:32] != name.split(".")[-2]:
            raise OSError(f"{name}: damaged")  # Numba compiles it again
        return pickle.loads(content)


def _digest(content: bytes) -> bytes:
    return hashlib.sha256(content).digest()


class KernelCache(caching.FunctionCache):  # type: ignore[misc]
    """Numba's cache of one function, in the folder that its sources stand for."""

    _impl_class = _Impl

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        stamp = self._impl.locator.get_source_stamp()
        file = _CheckedFile(self.cache_path, self._impl.filename_base, stamp)
        self._cache_file: Any = file

    def save_overload(self, signature: Any, data: Any) -> None:
        """Keep what was compiled; where that cannot be, it is used all the same."""
        try:
            super().save_overload(signature, data)
        except OSError as error:
            tell_unwritable(error)
