"""What a result was made with: enough to make it again, and to see why it differs."""

from __future__ import annotations

import hashlib
import json
import platform
import shutil
import subprocess
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from cavmarl.config import EnvConfig
from cavmarl.roads.network import RoadNetwork

__all__ = ["Manifest", "make_manifest"]

_ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Manifest:
    """Origin of a result.

    Attributes:
        cavmarl: version; None in a checkout that is not installed.
        git: commit of the checkout, with `+` where files differ from it; None outside of one.
        environment: name and version of the entry.
        config_hash: of the whole configuration, keywords and overrides included.
        map_hash: SHA-256 of the map's source.
        policy: name or path, as it was given.
        weights_hash: SHA-256 of a trained policy's weights.
        seed: world w of this seed ran episode w.
        episodes: how many.
        python, numpy, numba: versions.
        machine: processor and system.
    """

    cavmarl: str | None
    git: str | None
    environment: str
    config_hash: str
    map_hash: str
    policy: str
    weights_hash: str | None
    seed: int
    episodes: int
    python: str
    numpy: str
    numba: str
    machine: str


def make_manifest(
    config: EnvConfig,
    network: RoadNetwork,
    *,
    policy: str,
    weights: Path | None,
    seed: int,
    episodes: int,
) -> Manifest:
    """Note everything that a result depends on.

    Args:
        config: the environment.
        network: its roads.
        policy: name or path.
        weights: file of a trained policy.
        seed: of all episodes.
        episodes: how many.
    """
    text = json.dumps(asdict(config), sort_keys=True)
    return Manifest(
        cavmarl=_own_version(),
        git=_git_commit(),
        environment=f"{config.name}-v{config.version}",
        config_hash=hashlib.sha256(text.encode()).hexdigest()[:16],
        map_hash=network.source_hash,
        policy=policy,
        weights_hash=hashlib.sha256(weights.read_bytes()).hexdigest() if weights else None,
        seed=seed,
        episodes=episodes,
        python=platform.python_version(),
        numpy=version("numpy"),
        numba=version("numba"),
        machine=f"{_processor()}, {platform.system()} {platform.release()}",
    )


def _own_version() -> str | None:
    try:
        return version("cavmarl")
    except PackageNotFoundError:
        return None


def _git_commit() -> str | None:
    """The commit of the checkout that this file lies in."""
    git = shutil.which("git")
    if git is None or not (_ROOT / ".git").exists():
        return None
    command = [git, "-C", str(_ROOT), "describe", "--always", "--abbrev=40", "--dirty=+"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.stdout.strip() or None


def _processor() -> str:
    """The processor's name, where the system tells it."""
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
