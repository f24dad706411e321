"""Names of drivers: find the files of a policy without running or reading them."""

from __future__ import annotations

import difflib
from os.path import isdir, isfile
from pathlib import Path

from cavmarl.config.registry import agent_entries, agent_here
from cavmarl.core.errors import PolicyError

TOGETHER = "+"  # separates drivers that share the agents of a world
SB3_FILE = ".zip"  # suffixes of the model files of other libraries
TORCH_SCRIPT_FILES = (".pt", ".ts")
ONNX_FILE = ".onnx"
DRIVER_FILES = (".py", SB3_FILE, *TORCH_SCRIPT_FILES, ONNX_FILE)
SHIELDED = "shielded:"  # prefix; the built-in driver takes over when it would brake harder


def find_driver(policy: str | Path) -> Path:
    """Return the file or the folder of one driver.

    Args:
        policy: the name of an entry of `agents/`, or the path of a folder or of a file whose suffix
            is in `DRIVER_FILES`.

    Raises:
        PolicyError: nothing has that name, or it is not a driver.
    """
    if not isinstance(policy, str | Path):
        raise PolicyError(f"policy = {policy!r}: must be the name of a driver, or a path")
    known = agent_entries()
    here = agent_here(policy) if isinstance(policy, str) else None
    if isinstance(policy, str) and policy in known:
        if here is not None:
            raise PolicyError(
                f"policy '{policy}': both a driver of cavmarl and {here}; give the path of one"
            )
        return known[policy]
    path = Path(policy)
    if isdir(path):  # unlike Path.is_dir, isdir accepts names that no folder can have
        return path
    if isfile(path) and path.suffix in DRIVER_FILES:
        return path
    if isfile(path):
        raise PolicyError(
            f"{path}: not a policy; give a folder with model.safetensors, a .py file with "
            "make_policy, or a model of stable-baselines3 (.zip), TorchScript (.pt, .ts) or ONNX "
            "(.onnx)"
        )
    if here is not None:
        raise PolicyError(f"policy '{policy}': {here} is code in this folder; give its path")
    close = difflib.get_close_matches(str(policy), known, n=3)
    meant = f"did you mean {' or '.join(close)}? " if close else ""
    raise PolicyError(
        f"no policy, folder or file '{policy}'; {meant}Drivers: {', '.join(known) or 'none'}"
    )


def name_of_driver(path: Path) -> str:
    """Return the shortest text from which `find_driver` finds a driver: its name, or its path."""
    name = path.name.removesuffix(".py")
    return name if agent_entries().get(name) == path else str(path)


def shared_drivers(policy: str | Path) -> list[str]:
    """Return the drivers that share the agents; an empty list if `policy` is one driver."""
    if not isinstance(policy, str) or TOGETHER not in policy or Path(policy).exists():
        return []
    return policy.split(TOGETHER)


def drivers_in(policy: str | Path) -> list[str | Path]:
    """Return all single drivers in `policy`: `a+shielded:b` contains the drivers a and b."""
    if parts := shared_drivers(policy):
        return [driver for part in parts for driver in drivers_in(part)]
    if isinstance(policy, str) and policy.startswith(SHIELDED):
        return drivers_in(policy.removeprefix(SHIELDED))
    return [policy]
