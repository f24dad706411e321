"""Extensions that users register by name: one `Registry` for each kind.

Worker processes import the modules that registered extensions. So registration must happen when a
module is imported.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Iterable
from importlib.util import find_spec
from typing import Any, Generic, TypeVar

from cavmarl.core.errors import ConfigError, WorkerError

T = TypeVar("T")


class Registry(Generic[T]):
    """Entries of one kind by name, in order of registration."""

    def __init__(self, kind: str) -> None:
        self._kind = kind
        self._entries: dict[str, T] = {}
        self.modules: dict[str, str] = {}  # module of each entry

    def __contains__(self, name: str) -> bool:
        return name in self._entries

    def __getitem__(self, name: str) -> T:
        try:
            return self._entries[name]
        except KeyError:
            raise ConfigError(f"{self._kind} '{name}': {self.advice()}") from None

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._entries)

    def add(
        self,
        name: str,  # a Python name
        entry: T,  # the registered object
        source: Callable[..., Any],  # a function of the module that registers it
        taken: Iterable[str],  # names of the package's own entries
    ) -> None:
        """Register an entry; a module can register its own names again."""
        module = inspect.unwrap(getattr(source, "py_func", source)).__module__
        if not name.isidentifier():
            raise ConfigError(
                f"{self._kind} {name!r}: must have letters, digits and _ only, and no digit first"
            )
        if name in taken:
            raise ConfigError(f"{self._kind} '{name}': cavmarl has this name; use another name")
        if self.modules.get(name, module) != module:
            raise ConfigError(
                f"{self._kind} '{name}': already registered by {self.modules[name]}; use another "
                "name"
            )
        self._entries[name] = entry
        self.modules[name] = module

    def remove(self, name: str) -> None:
        del self._entries[name], self.modules[name]

    def advice(self) -> str:
        """Return advice for a name that is not registered."""
        known = ", ".join(self._entries) or "none"
        return f"not registered (registered: {known}); see cavmarl.register_{self._kind}"


REGISTERED_TERMS: Registry[Any] = Registry("term")
REGISTERED_SENSORS: Registry[Any] = Registry("sensor")
REGISTERED_MODELS: Registry[int] = Registry("driver_model")


def extension_modules(names: Iterable[str]) -> list[str]:
    """Return the modules that other processes must import, in order of registration."""
    found: dict[str, None] = {}
    used = set(names)
    for registry in (REGISTERED_TERMS, REGISTERED_SENSORS, REGISTERED_MODELS):
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


def _is_importable(module: str) -> bool:
    """Return whether another process can import a module; False for code of a notebook."""
    try:
        return module != "__main__" and find_spec(module) is not None
    except (ImportError, ValueError):
        return False


def load_extensions(modules: Iterable[str]) -> None:
    """Import the modules that register the extensions of a configuration."""
    for module in modules:
        try:
            importlib.import_module(module)
        except ImportError as error:
            raise WorkerError(
                f"{module}, which registers parts of the world, cannot be imported: {error}"
            ) from error
