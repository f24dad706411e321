"""Sensing of the lanes for the agents of signals, as `signals.sensing` says."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.compiled.bound_call import BoundCall, bind
from cavmarl.core.errors import ConfigError
from cavmarl.signals.kernels.camera_counts import count_by_cameras
from cavmarl.signals.kernels.loop_counts import DETECTED, estimate_by_loops, read_loops
from cavmarl.signals.kernels.message_counts import count_by_messages
from cavmarl.signals.kernels.signal_steps import SignalOutputs, SignalRules, SignalWorlds
from cavmarl.signals.sensing import make_cameras, make_loops, make_unit_lanes
from cavmarl.signals.signal_table import SignalTable
from cavmarl.v2x.bus import Bus

if TYPE_CHECKING:
    from cavmarl.engine.component import ComponentContext
    from cavmarl.engine.v2x_component import V2xComponent

log = logging.getLogger(__name__)


class SignalSensing:
    """The sensors of the lanes of signals; they write `outputs.counts` and `outputs.loops`.

    Args:
        host: the worlds.
        messages: the messages of the worlds, if there are any.
        table: the signals.
        rules: the signals, for kernels.
        worlds: the state of the worlds.
        outputs: what agents know.
        chosen: (W,) the worlds in which a tick ends.
        observed: (W,) the worlds to observe at the end of a step.

    Attributes:
        tick_calls: calls at the end of a tick.
        step_calls: calls at the end of a step, after the true counts are known.
        truth: (W, N, COUNTS) the true counts; `outputs.counts` if they are what agents know.
        kept: arrays (W, …) that outlive a tick.
        reads_ticks: whether `tick_calls` read the vehicles of all zones.

    Raises:
        ConfigError: `signals.sensing` is v2x, and a signal has no roadside unit.
    """

    def __init__(
        self,
        host: ComponentContext,
        messages: V2xComponent | None,
        table: SignalTable,
        rules: SignalRules,
        worlds: SignalWorlds,
        outputs: SignalOutputs,
        *,
        chosen: NDArray[np.bool_],
        observed: NDArray[np.bool_],
    ) -> None:
        config, zoned = host.config.signals, host.division.zoned
        counts, readings = outputs.counts, outputs.loops
        self.tick_calls: list[BoundCall[None]] = []
        self.step_calls: list[BoundCall[None]] = []
        self.truth = counts if config.sensing == "truth" else np.zeros_like(counts)
        self.kept: tuple[NDArray[Any], ...] = ()
        self.reads_ticks = config.sensing == "loops"
        self._counts = counts
        self._bus: Bus | None = None
        self._full: NDArray[np.int64] | None = None  # see `UnitLanes`
        if config.sensing == "loops":
            detected = host.zeros((*readings.shape[:3], DETECTED), dtype=np.int64)
            self.kept = detected, readings
            loops = make_loops(config, table, rules.dt, detected)
            self.tick_calls.append(bind(read_loops, rules, worlds, loops, chosen))
            self.step_calls.append(
                bind(estimate_by_loops, rules, worlds, loops, observed, readings, counts)
            )
        elif config.sensing == "camera":
            most = zoned.rows.shape[1] * zoned.rows.shape[3]
            cameras = make_cameras(config, host.network, table, most)
            self.step_calls.append(bind(count_by_cameras, rules, worlds, cameras, observed, counts))
        elif config.sensing == "v2x" and messages is not None:
            self._bus = messages.bus
            units = make_unit_lanes(host.network, table, _receivers(table, messages.bus))
            self._full = units.full
            inboxes = messages.bus.mail.objects
            self.step_calls.append(
                bind(count_by_messages, rules, worlds, units, inboxes, observed, counts)
            )

    def reset(self, chosen: NDArray[np.bool_]) -> None:
        """Forget the last episode of the chosen worlds (W,)."""
        for array in (self._counts, *self.kept):
            array[chosen] = 0
        if self._bus is not None:
            self._bus.reset(chosen)

    def tell_of_full_inboxes(self) -> None:
        """Log once that inboxes of roadside units were full, so that vehicles were not counted."""
        if self._bus is None or self._full is None or not self._full[0]:
            return
        log.warning(
            "signals.sensing = v2x: %d roadside units have full inboxes of %d vehicles; farther "
            "vehicles are not counted (v2x.inbox.objects, at most 64)",
            self._full[0], self._bus.mail.objects.shape[2],
        )  # fmt: skip
        self._full = None


def _receivers(table: SignalTable, bus: Bus) -> NDArray[np.int64]:
    """Return the row (S,) of each signal's roadside unit among the inboxes."""
    unit_of = {signal: unit for unit, signal in enumerate(bus.units["signal"].tolist())}
    rows = table.arrays.row.tolist()
    missing = [table.ids[s] for s, row in enumerate(rows) if row not in unit_of]
    if missing:
        raise ConfigError(
            f"signals.sensing = v2x: {len(missing)} signals with agents have no roadside unit, "
            f"such as {missing[0]!r}; set v2x.roadside.signals to [all]"
        )
    return np.array([bus.receiver_of_unit(unit_of[row]) for row in rows], dtype=np.int64)
