"""What has become of the messages of one world since its reset."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cavmarl.v2x.kernels.v2x_records import (
    BAND_M,
    COUNT_NO_ACCESS,
    COUNT_OVERFLOW,
    COUNT_REACHABLE,
    COUNT_RECEIVED,
    COUNT_SENT,
    NUM_KINDS,
    Mail,
)


@dataclass(frozen=True)
class V2xStatistics:
    """Counts and ratios of one world; receivers are the agents and the roadside units."""

    sent: tuple[int, ...]  # packets of each kind: CAM, DENM, CPM, SPAT
    overflow: int  # packets for which there was no room (`v2x.capacity`)
    no_access: int  # packets that never found the air free
    reachable: int  # pairs of a packet and a receiver within reach of it
    received: int  # those of them that received it
    delays: NDArray[np.int64]  # (65,) receptions by ticks of delay
    mean_latency_s: float  # of the receptions
    # (40, 2) reachable and received, in bands of `BAND_M`; of channels that lose packets
    bands: NDArray[np.int64]
    busy_mean: float  # channel busy ratio, mean over receivers and ticks
    busy_max: float  # the largest

    @property
    def reception_ratio(self) -> float:
        """Packet reception ratio, 1 where nothing could be received."""
        return self.received / self.reachable if self.reachable else 1.0

    def ratio_by_distance(self) -> dict[float, float]:
        """Packet reception ratio by the middle of each band of distance, m."""
        return {
            (band + 0.5) * BAND_M: received / reachable
            for band, (reachable, received) in enumerate(self.bands.tolist())
            if reachable
        }

    def to_dict(self) -> dict[str, float]:
        """The numbers of a report, named as in `traffic_stats`."""
        return {
            "v2x_sent": float(sum(self.sent)),
            "v2x_received": float(self.received),
            "v2x_lost": float(self.reachable - self.received),
            "v2x_dropped": float(self.overflow + self.no_access),
            "v2x_reception_ratio": self.reception_ratio,
            "v2x_latency_s": self.mean_latency_s,
            "v2x_busy_ratio": self.busy_mean,
        }


def statistics_of(mail: Mail, world: int, tick_s: float) -> V2xStatistics:
    counts = mail.counts[world]
    delays = mail.delays[world].copy()
    busy_sum, busy_number, busy_max = mail.busy[world].tolist()
    total = int(delays.sum())
    late = int((delays * np.arange(len(delays))).sum())
    return V2xStatistics(
        sent=tuple(counts[COUNT_SENT : COUNT_SENT + NUM_KINDS].tolist()),
        overflow=int(counts[COUNT_OVERFLOW]),
        no_access=int(counts[COUNT_NO_ACCESS]),
        reachable=int(counts[COUNT_REACHABLE]),
        received=int(counts[COUNT_RECEIVED]),
        delays=delays,
        mean_latency_s=tick_s * late / total if total else 0.0,
        bands=mail.bands[world].copy(),
        busy_mean=busy_sum / busy_number if busy_number else 0.0,
        busy_max=busy_max,
    )
