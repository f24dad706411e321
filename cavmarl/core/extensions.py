"""Extensions that users register by name: one `Registry` for each kind.

Plugins are modules that register extensions when they are imported. A configuration names plugins,
and installed packages declare plugins as entry points of the group `ENTRY_POINTS`. Worker processes
import the same modules.
"""

from __future__ import annotations

import hashlib
import importlib
import inspect
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Generic, TypeVar

from cavmarl.core.errors import CavmarlError, ConfigError
from cavmarl.core.tracebacks import fault_in

T = TypeVar("T")

ENTRY_POINTS = "cavmarl.plugins"  # group of the entry points that packages declare
HOW = (
    "add --import MODULE to the command, plugins: [MODULE] to env.yaml, or import the module first"
)


class Registry(Generic[T]):
    """Entries of one kind by name, in order of registration.

    The entry points are loaded when a name is looked up that is not yet registered, or when all
    names are listed.
    """

    def __init__(self, kind: str) -> None:
        self._kind = kind
        self._entries: dict[str, T] = {}
        self._sources: dict[str, Callable[..., Any]] = {}
        self.modules: dict[str, str] = {}  # module of each entry

    def __contains__(self, name: object) -> bool:
        if name not in self._entries:
            load_entry_points()
        return name in self._entries

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self._entries)

    def __getitem__(self, name: str) -> T:
        if name not in self:
            raise ConfigError(f"{self._kind} '{name}': {self.advice()}")
        return self._entries[name]

    @property
    def names(self) -> tuple[str, ...]:
        load_entry_points()
        return tuple(self._entries)

    def add(
        self,
        name: str,  # a Python name
        entry: T,  # the registered object
        source: Callable[..., Any],  # a function of the module that registers it
        taken: Iterable[str],  # names of the package's own entries
    ) -> None:
        """Register an entry.

        Raises ConfigError: the name is not valid, or is taken by another function. A function that
        its module defines again, as after an edit in a notebook, replaces the earlier one.
        """
        source = inspect.unwrap(getattr(source, "py_func", source))
        module = source.__module__
        if not name.isidentifier():
            raise ConfigError(
                f"{self._kind} {name!r}: must have letters, digits and _ only, and no digit first"
            )
        if name in taken:
            raise ConfigError(f"{self._kind} '{name}': cavmarl has this name; use another name")
        if name in self._entries and not _is_redefined(self._sources[name], source):
            raise ConfigError(
                f"{self._kind} '{name}': already registered by {self.modules[name]} for another "
                "function; use another name"
            )
        self._entries[name] = entry
        self._sources[name] = source
        self.modules[name] = module

    def remove(self, name: str) -> None:
        del self._entries[name], self._sources[name], self.modules[name]

    def advice(self) -> str:
        """Return advice for a name that is not registered."""
        known = ", ".join(self._entries) or "none"
        return (
            f"not registered (registered: {known}). If a module registers it with "
            f"cavmarl.register_{self._kind}, {HOW}"
        )


def _is_redefined(earlier: Callable[..., Any], later: Callable[..., Any]) -> bool:
    """Return whether `later` is the function `earlier`, possibly defined again by its module."""
    name = getattr(later, "__qualname__", "<")  # other callables have no name of their own
    return later is earlier or (
        "<" not in name  # neither a lambda nor local to a function
        and name == getattr(earlier, "__qualname__", "")
        and later.__module__ == earlier.__module__
    )


REGISTERED_TERMS: Registry[Any] = Registry("term")
REGISTERED_SENSORS: Registry[Any] = Registry("sensor")
REGISTERED_MODELS: Registry[int] = Registry("driver_model")
REGISTERED_BACKENDS: Registry[Any] = Registry("backend")
REGISTERED_ZONE_SIMULATORS: Registry[Any] = Registry("zone_simulator")

_OF_WORLDS = (
    REGISTERED_TERMS,
    REGISTERED_SENSORS,
    REGISTERED_MODELS,
    REGISTERED_ZONE_SIMULATORS,
)


def load_plugins(modules: Iterable[str], failure: type[CavmarlError] = ConfigError) -> None:
    """Import the modules that register extensions.

    Raises:
        CavmarlError: a module does not exist, or its import fails; the class is `failure`.
    """
    for module in modules:
        parts = module.split(".")
        if parts[-1] == "py" or not all(part.isidentifier() for part in parts):
            raise failure(
                f"plugin {module!r}: must be the name of a module, such as my_terms for the file "
                "my_terms.py, or my_package.terms"
            )
        try:
            importlib.import_module(module)
        except ModuleNotFoundError as error:
            if error.name is None or not f"{module}.".startswith(f"{error.name}."):
                raise failure(_fault(module, error)) from error
            raise failure(
                f"plugin '{module}': there is no module '{error.name}'; install its package, or "
                "put its folder on PYTHONPATH. The option --import also finds modules in the "
                "working directory"
            ) from error
        except Exception as error:  # the user's module may raise any exception
            raise failure(_fault(module, error)) from error


def import_plugins(modules: Iterable[str]) -> None:
    """Import the modules that a command line names; the working directory is searched last."""
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)  # processes that this one starts search the same folders
    load_plugins(modules)


def load_entry_points() -> None:
    """Import the plugins that installed packages declare, once.

    Raises ConfigError: the import of a plugin fails.
    """
    left = pending_entry_points()
    while left:
        point = left.pop(0)  # before the import, in which the plugin may look names up
        try:
            point.load()
        except Exception as error:  # the plugin may raise any exception
            left.insert(0, point)  # so that the next lookup reports it again
            package = "" if point.dist is None else f" of the package {point.dist.name}"
            raise ConfigError(
                f"entry point {point.name}{package} in the group {ENTRY_POINTS}: "
                f"{_fault(point.value, error)}; repair or uninstall the package"
            ) from error


@cache
def pending_entry_points() -> list[EntryPoint]:
    """Return the entry points that are still to be loaded; loading removes them."""
    return sorted(entry_points(group=ENTRY_POINTS))


def _fault(module: str, error: Exception) -> str:
    return f"plugin '{module}' cannot be imported: {fault_in(Path(module), error)}"


def extension_modules(names: Iterable[str], plugins: Iterable[str]) -> list[str]:
    """Return the modules that other processes must import; plugins come first.

    `names`: extensions of the world. Raises ConfigError: one of them is registered by a module that
    cannot be imported.
    """
    found = dict.fromkeys(plugins)
    used = set(names)
    for registry in _OF_WORLDS:
        for name, module in registry.modules.items():
            if _is_importable(module):
                found[module] = None
            elif name in used:
                place = "the program itself" if module == "__main__" else f"'{module}'"
                raise ConfigError(
                    f"'{name}' is registered in {place}, which workers cannot import: "
                    "move it to a module of its own, or do not use workers"
                )
    return list(found)


def plugin_hashes(names: Iterable[str], plugins: Iterable[str]) -> dict[str, str]:
    """Return the SHA-256 of the file of each plugin and of each module that registered a name.

    The text is empty for modules without a file. Arguments as for `extension_modules`.
    """
    used = set(names)
    modules = [
        module
        for registry in _OF_WORLDS
        for name, module in registry.modules.items()
        if name in used
    ]
    return {module: _hash_of(module) for module in dict.fromkeys([*plugins, *modules])}


def _hash_of(module: str) -> str:
    file = getattr(sys.modules.get(module), "__file__", None)
    try:
        return hashlib.sha256(Path(file).read_bytes()).hexdigest() if file else ""
    except OSError:
        return ""


def _is_importable(module: str) -> bool:
    """Return whether another process can import a module; False for code of a notebook."""
    try:
        return module != "__main__" and find_spec(module) is not None
    except (ImportError, ValueError):
        return False
