"""Copies and pickles of environments: each is a world of its own, which goes on bit for bit."""

from __future__ import annotations

from copy import deepcopy
from typing import Any, ClassVar

from cavmarl.env.actions import ActionDecoder
from cavmarl.env.insertions import Insertions
from cavmarl.parallel.step_arrays import SteppedWorlds


class OwnWorlds:
    """Base of whatever holds worlds: a shallow copy would step those of the first one."""

    def __copy__(self) -> Any:
        """As `copy.deepcopy`: two environments never step the same worlds."""
        return deepcopy(self)


class CopiedWithWorlds(OwnWorlds):
    """Base of an environment that `copy` and `pickle` take apart into its worlds and the rest.

    Everything that refers to arrays of the worlds is made anew by `__init__`.

    Attributes:
        worlds: that it steps.
    """

    # What `__init__` makes of the worlds, and is therefore not copied.
    _MADE_OF_WORLDS: ClassVar = frozenset(
        (
            "worlds", "config", "network", "_view", "_read_only", "_decoder", "_writer",
            "_watchers", "_insertions",
        )
    )  # fmt: skip

    worlds: SteppedWorlds
    _decoder: ActionDecoder
    _insertions: Insertions

    def __reduce__(self) -> tuple[Any, ...]:
        kept = {
            name: value for name, value in vars(self).items() if name not in self._MADE_OF_WORLDS
        }
        return _made_again, (type(self), self.worlds), (
            kept, self._decoder.memory, self._insertions.memory
        )  # fmt: skip

    def __setstate__(self, state: tuple[dict[str, Any], Any, Any]) -> None:
        kept, self._decoder.memory, self._insertions.memory = state
        vars(self).update(kept)


def _made_again(kind: type[Any], worlds: SteppedWorlds) -> Any:
    made: Any = object.__new__(kind)
    base = next(cls for cls in kind.__mro__ if CopiedWithWorlds in cls.__bases__)
    base.__init__(made, worlds)  # type: ignore[misc] # a subclass may take other arguments
    return made
