"""The phases of a tick that move vehicles without cavmarl's drivers.

SUMO moves its vehicles here; the caller's vehicles move in `ExternalPhases`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.records.arrays import Worlds
from cavmarl.engine.step_trace import MIRROR, SUMO
from cavmarl.handoff.coordinator.message_coordinator import ZoneGate
from cavmarl.traffic.sumo.sumo_traffic import SumoTraffic

if TYPE_CHECKING:
    from cavmarl.engine.peers import Peers
    from cavmarl.engine.tick import Tick


class OutsideTraffic:
    """The part of a tick that another simulator or the caller may take over.

    By default, neither moves vehicles, and signals follow their own programs.

    Attributes:
        sumo: SUMO, or None.
        gate: the simulators of zones, which may refuse vehicles; None: there are none.
    """

    sumo: SumoTraffic | None = None
    gate: ZoneGate | None = None

    def reset(self, chosen: NDArray[np.bool_], worlds: Worlds) -> None:
        """Begin an episode in the chosen worlds (W,)."""

    def catch_up(self, worlds: Worlds) -> None:
        """Resume from the state of worlds that were loaded. Raises as `SumoTraffic` does."""

    def host(self, zones: Sequence[int]) -> None:
        """From now on, move vehicles only in these zones: other processes run the other zones."""

    def follow(self, tick: Tick) -> None:
        """Move the vehicles of the other simulator, after cavmarl's own vehicles."""

    def mirror_people(self, tick: Tick, people: Sequence[NDArray[np.void]]) -> None:
        """Move the persons of the other simulator; `people`: SEEN of each world."""

    def let_in(self, tick: Tick) -> None:
        """Add the vehicles that have entered in the other simulator."""

    def running(self, peers: Peers) -> NDArray[np.int64]:
        """Return how many places (W,) of each world are taken or reserved."""
        return peers.running()

    def switch_signals(self, tick: Tick) -> None:
        """Switch the signals to the present tick, once all zones have read their detectors."""
        tick.executor.detect()
        tick.peers.share_detections(tick.worlds)
        tick.shared.switch_signals(tick.common)

    def close(self) -> None:
        """End the other simulator."""


class SumoPhases(OutsideTraffic):
    """The phases of a tick in worlds with SUMO.

    Attributes:
        callers: the phases of vehicles that the caller poses or drives.
    """

    def __init__(self, traffic: SumoTraffic, callers: OutsideTraffic | None = None) -> None:
        self.sumo = self._sumo = traffic
        self.callers = OutsideTraffic() if callers is None else callers

    def reset(self, chosen: NDArray[np.bool_], worlds: Worlds) -> None:
        """Restart SUMO in the chosen worlds (W,)."""
        self._sumo.reset(chosen, worlds)

    def catch_up(self, worlds: Worlds) -> None:
        """Replay SUMO's commands up to the worlds' ticks."""
        self._sumo.catch_up(worlds)

    def follow(self, tick: Tick) -> None:
        """Step SUMO; if it drives the vehicles, move them to their new places or remove them."""
        self.callers.follow(tick)  # SUMO receives the new places of these vehicles
        sumo, departures, worlds, side = (
            self._sumo,
            tick.departures,
            tick.worlds,
            tick.division.next_side,
        )
        tick.note_phase(SUMO)
        with tick.all_rows(True, side):
            sumo.step(worlds, side)
            if not sumo.drives:
                sumo.send_on(departures, worlds, side)
                return
        tick.note_phase(MIRROR)
        self.callers.mirror_people(tick, sumo.people)
        if sumo.mirror(worlds, side):
            tick.executor.dismiss(departures)
            tick.coordination.left(departures)
            sumo.forgive(departures)
        tick.peers.share_leavers(departures)
        if any(departures.num_passing.tolist()):
            tick.traffic.settle(departures, worlds)

    def let_in(self, tick: Tick) -> None:
        """Add vehicles that have entered in SUMO: as rows if SUMO drives, else queued."""
        sumo, departures, worlds = self._sumo, tick.departures, tick.worlds
        tick.finish_phase()
        if not sumo.drives:
            sumo.order(departures, worlds)
        elif sumo.let_in(departures, worlds, tick.peers.running()):
            tick.admit()
        self.callers.let_in(tick)

    def running(self, peers: Peers) -> NDArray[np.int64]:
        """Return how many places (W,) of each world are taken, or reserved for the caller."""
        return self.callers.running(peers)

    def switch_signals(self, tick: Tick) -> None:
        """Copy the states of SUMO's signals."""
        self._sumo.show(tick.worlds)

    def close(self) -> None:
        """End SUMO."""
        self._sumo.close()
