"""What a program runs on and from: processor, memory, system, packages, commit."""

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
    """What stands in every record: hardware, software and code."""
    return {
        "hardware": describe_hardware(),
        "software": describe_software(),
        "code": describe_code(),
    }


def describe_hardware() -> dict[str, str | int | float | list[str] | None]:
    """Processor, cores, memory and GPUs; None where the system does not tell."""
    return {
        "cpu": _processor(),
        "architecture": platform.machine(),
        "logical_cores": os.cpu_count(),
        "usable_cores": _usable_cores(),
        "memory_gb": _memory_gb(),
        "gpus": _gpus(),
    }


def describe_software() -> dict[str, str | dict[str, str | None]]:
    """System, Python, and versions of the packages that a result depends on; None: not there."""
    return {
        "os": platform.platform(),
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        "packages": {name: _version(name) for name in PACKAGES},
    }


def describe_code() -> dict[str, str | bool | None]:
    """Commit of the checkout that this package lies in, and whether files differ from it."""
    git = shutil.which("git")
    if git is None or not (_ROOT / ".git").exists():
        return {"commit": UNKNOWN_COMMIT, "dirty": None}
    commit = _said([git, "-C", str(_ROOT), "rev-parse", "HEAD"])
    if not commit:
        return {"commit": UNKNOWN_COMMIT, "dirty": None}
    return {
        "commit": commit,
        "dirty": bool(_said([git, "-C", str(_ROOT), "status", "--porcelain"])),
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _processor() -> str:
    """The processor's name, where the system tells it; else its architecture."""
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
    """NVIDIA GPUs with their identifiers; evaluation itself runs on the processor."""
    tool = shutil.which("nvidia-smi")
    return _said([tool, "-L"]).splitlines() if tool else []


def _said(command: list[str]) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.stdout.strip() if done.returncode == 0 else ""
