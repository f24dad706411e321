"""`MovingMemory`: what worker processes share where worlds or zones change their worker."""

from __future__ import annotations

from cavmarl.core.errors import WorkerError
from cavmarl.parallel.processes.shared_memory import Segment, arrays_in, size_of

_CASE_BYTES = 1 << 12  # of what a worker leaves for others; it grows


class MovingMemory:
    """What shards have cost, and a case for each worker that may give whole worlds away.

    Args:
        num_worlds: W.
        num_zones: of each world, as they are placed; whole worlds count as one.
        cases: how many.

    Attributes:
        segments: the memory.
        recipe: what workers are told about it.
        spent_s: (W, zones) processor time of each shard from the start on.

    Raises:
        WorkerError: there is none.
    """

    def __init__(self, num_worlds: int, num_zones: int, cases: int) -> None:
        layout = {"spent_s": ("<f8", (num_worlds, num_zones))}
        self.segments = [Segment.make(size_of(layout))]
        try:
            self.segments += [Segment.make(_CASE_BYTES) for _ in range(cases)]
            self.spent_s = arrays_in(self.segments[0].map(), layout)["spent_s"]
        except WorkerError:
            for segment in self.segments:
                segment.close()
            raise
        spent, *others = (segment.fd for segment in self.segments)
        self.recipe = {"spent": spent, "layout": layout, "cases": others}
