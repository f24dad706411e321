"""Description of the machine and the code: processor, memory, system, packages, commit."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

_ROOT = Path(__file__).resolve().parents[2]

PACKAGES = (
    "cavmarl",
    "numpy",
    "numba",
    "llvmlite",
    "gymnasium",
    "pettingzoo",
    "pydantic",
    "PyYAML",
    "sumolib",
    "eclipse-sumo",
    "torch",
    "safetensors",
)
UNKNOWN_COMMIT = "unknown: not a checkout"


def describe_machine() -> dict[str, Any]:
    """Return the hardware, software and code for the header of a record."""
    return {
        "hardware": describe_hardware(),
        "software": describe_software(),
        "code": describe_code(),
    }


def describe_hardware() -> dict[str, str | int | float | list[str] | None]:
    """Return processor, cores, memory and GPUs; None for what the system does not report."""
    return {
        "cpu": _processor(),
        "architecture": platform.machine(),
        "logical_cores": os.cpu_count(),
        "usable_cores": _usable_cores(),
        "memory_gb": _memory_gb(),
        "gpus": _gpus(),
    }


def describe_software() -> dict[str, str | dict[str, str | None]]:
    """Return system, Python, and versions of relevant packages; None: not installed."""
    return {
        "os": platform.platform(),
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        "packages": {name: _version(name) for name in PACKAGES},
    }


def describe_code() -> dict[str, str | bool | None]:
    """Return the commit of this package's checkout, and whether files differ from it."""
    git = shutil.which("git")
    if git is None or not (_ROOT / ".git").exists():
        return {"commit": UNKNOWN_COMMIT, "dirty": None}
    commit = _output_of([git, "-C", str(_ROOT), "rev-parse", "HEAD"])
    if not commit:
        return {"commit": UNKNOWN_COMMIT, "dirty": None}
    return {
        "commit": commit,
        "dirty": bool(_output_of([git, "-C", str(_ROOT), "status", "--porcelain"])),
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _processor() -> str:
    """Return the processor's name if the system reports it, otherwise its architecture."""
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _usable_cores() -> int | None:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def _memory_gb() -> float | None:
    names = getattr(os, "sysconf_names", {})
    if not {"SC_PHYS_PAGES", "SC_PAGE_SIZE"} <= names.keys():
        return None
    return round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9, 1)


def _gpus() -> list[str]:
    """Return NVIDIA GPUs with their identifiers; evaluation does not use them."""
    tool = shutil.which("nvidia-smi")
    return _output_of([tool, "-L"]).splitlines() if tool else []


def _output_of(command: list[str]) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.stdout.strip() if done.returncode == 0 else ""
