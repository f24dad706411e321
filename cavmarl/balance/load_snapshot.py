"""`LoadSnapshot`: the resource use of each worker at one time.

A placement depends on live measurements only through a snapshot, so a snapshot stored in a manifest
gives the same plan again. `probe` takes a snapshot of this machine.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from cavmarl.balance.load_score import Candidate, Utilisation
from cavmarl.core.errors import ConfigError

NO_GPU = "none"
SUPPOSED_IDLE = "supposed idle"


@dataclass(frozen=True)
class LoadSnapshot:
    """Utilisation of all workers."""

    workers: tuple[Candidate, ...]  # at least one worker, by number
    gpu_source: str  # source of the use of GPUs; `none`: there is no GPU, and its use counts as 0
    origin: str  # source of the shares: `measured`, `supposed idle`, `generated`

    def __post_init__(self) -> None:
        numbers = [candidate.worker for candidate in self.workers]
        if not numbers:
            raise ConfigError("the snapshot has no workers; there must be at least one")
        if len(set(numbers)) != len(numbers):
            raise ConfigError(f"workers {sorted(numbers)}: each must be named once")
        ordered = sorted(self.workers, key=lambda one: one.worker)
        object.__setattr__(self, "workers", tuple(ordered))

    def to_dict(self) -> dict[str, Any]:
        return asdict(self) | {"workers": [asdict(worker) for worker in self.workers]}


def idle_snapshot(count: int) -> LoadSnapshot:
    """Return a snapshot of idle workers 0 to `count` - 1."""
    idle = Utilisation(0.0, 0.0)
    workers = tuple(Candidate(worker, idle) for worker in range(count))
    return LoadSnapshot(workers, NO_GPU, SUPPOSED_IDLE)
