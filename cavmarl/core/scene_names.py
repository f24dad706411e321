"""Names of files with a logged scene, which provide a map and the vehicles on it."""

from __future__ import annotations

SCENE_SUFFIXES = (".json", ".pkl")


def is_scene_file(name: str) -> bool:
    """Return whether a file of this name is read as a logged scene."""
    return name.endswith(SCENE_SUFFIXES)
