"""`GreenFeatures`: the state of each green of each signal, for neural networks that score greens.

The features of a green do not depend on the layout of its junction. So one neural network can
control signals with any number of greens and lanes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavmarl.signals.controllers import SignalView
from cavmarl.signals.kernels.controlled_signals import LaneWeights
from cavmarl.signals.kernels.green_choices import GREEN, SINCE
from cavmarl.signals.kernels.lane_counts import SPEED_PPM, STANDING, STOOD_TICKS, VEHICLES
from cavmarl.signals.signal_table import SignalTable

# Features of each green; "/ 10": divided by 10. Sums and maxima are over the lanes that it opens.
GREEN_FEATURES = (
    "exists",  # 1 for a green of the signal, 0 for padding
    "allowed",  # whether it may be chosen now
    "shown",  # whether it is the current green
    "vehicles",  # / 10
    "standing",  # / 10
    "slowed",  # sum of 1 - speed / desired speed, / 10
    "most_vehicles",  # largest number on one lane, / 10
    "most_standing",  # largest number on one lane, / 10
    "waited",  # sum of the times that vehicles have been stopped, / 200 s
    "most_waited",  # largest sum on one lane, / 200 s
    "pressure",  # see `SignalTable`, / 10
    "behind",  # vehicles on the outgoing lanes, / 20
    "standing_behind",  # stopped vehicles on the outgoing lanes, / 10
    "most_filled",  # vehicles on a lane / stopped vehicles that fit on it; largest of the lanes
    "movements",  # number of movements that the green opens, / 5
)
SIGNAL_FEATURES = (
    "vehicles",  # on the lanes before the signal, / 20
    "standing",  # / 20
    "slowed",  # / 20
    "lasted",  # time since the last change, at most 120 s, / 60 s
    "begun",  # time since the last change, at most 20 s, / 20 s
)
MOST = 5.0  # upper limit of all features
_VEHICLE_M = 7.5  # length of a stopped vehicle with its gap


class GreenFeatures:
    """Computes the features of S signals with at most G greens.

    A row has `GREEN_FEATURES` for each green, then `SIGNAL_FEATURES`, then the number of the signal
    in one-hot encoding (omitted if there is only one signal).

    Args:
        table: the signals.

    Attributes:
        size: D, the length of a row.
        num_greens: G.
        num_shared: values of a row that do not belong to a green.
    """

    def __init__(self, table: SignalTable) -> None:
        arrays, lanes = table.arrays, len(table.lanes)
        self.num_greens = table.sizes.greens
        shape = (len(table.ids), self.num_greens)
        num_ids = shape[0] if shape[0] > 1 else 0
        self.num_shared = len(SIGNAL_FEATURES) + num_ids
        self.size = self.num_greens * len(GREEN_FEATURES) + self.num_shared
        self._shape = shape
        self._ids = np.eye(shape[0], num_ids, dtype=np.float32)
        self._exists = np.arange(self.num_greens) < arrays.num_greens[:, None]
        self._served = _dense(table.served, lanes)
        self._pressure = _dense(table.pressure, lanes)
        self._behind = np.zeros_like(self._served)
        self._movements = np.zeros(shape, dtype=np.float32)
        self._before = np.zeros((shape[0], lanes), dtype=np.float32)
        for s, (moves, opened) in enumerate(zip(table.movements, table.opened, strict=True)):
            self._before[s, arrays.approach[s][arrays.approach[s] >= 0]] = 1.0
            self._movements[s, : len(opened)] = opened.sum(axis=1)
            for g, is_open in enumerate(opened):
                self._behind[s * self.num_greens + g, moves[is_open, 1]] = 1.0
        self._held = np.maximum(arrays.length_m, _VEHICLE_M) / _VEHICLE_M
        # Lanes of each green, padded with the index of an empty lane.
        most = max(int(self._served.sum(axis=1).max(initial=0.0)), 1)
        self._lanes = np.full((len(self._served), most), lanes)
        for row, served in zip(self._lanes, self._served, strict=True):
            found = np.flatnonzero(served)
            row[: len(found)] = found

    def of(self, view: SignalView) -> NDArray[np.float32]:
        """Return the features (W, S, D)."""
        counts = view.counts.astype(np.float32)
        vehicles, standing = counts[..., VEHICLES], counts[..., STANDING]
        waited_s = counts[..., STOOD_TICKS] * np.float32(view.dt)
        slowed = vehicles - counts[..., SPEED_PPM] * np.float32(1e-6)
        filled = np.minimum(vehicles / self._held, 1.0)
        green = view.states[..., GREEN]
        of_greens = [
            np.broadcast_to(self._exists, (len(counts), *self._shape)),
            self._allowed(view),
            np.arange(self.num_greens) == green[..., None],
            self._sums(self._served, vehicles) / 10.0,
            self._sums(self._served, standing) / 10.0,
            self._sums(self._served, slowed) / 10.0,
            self._most(vehicles) / 10.0,
            self._most(standing) / 10.0,
            self._sums(self._served, waited_s) / 200.0,
            self._most(waited_s) / 200.0,
            self._sums(self._pressure, vehicles) / 10.0,
            self._sums(self._behind, vehicles) / 20.0,
            self._sums(self._behind, standing) / 10.0,
            self._most(filled),
            np.broadcast_to(self._movements / 5.0, (len(counts), *self._shape)),
        ]
        since_s = (view.ticks[:, None] - view.states[..., SINCE]) * view.dt
        of_signals = [
            vehicles @ self._before.T / 20.0,
            standing @ self._before.T / 20.0,
            slowed @ self._before.T / 20.0,
            np.minimum(since_s, 120.0) / 60.0,
            np.minimum(since_s, 20.0) / 20.0,
        ]
        shape = (len(counts), self._shape[0], -1)
        row = [
            np.stack(of_greens, axis=-1).reshape(shape),
            np.stack(of_signals, axis=-1),
            np.broadcast_to(self._ids, (len(counts), *self._ids.shape)),
        ]
        return np.concatenate(row, axis=-1).astype(np.float32).clip(-MOST, MOST)

    def _allowed(self, view: SignalView) -> NDArray[np.bool_]:
        """Return which greens (W, S, G) may be chosen; if none may, the current green."""
        shown = np.arange(self.num_greens) == view.states[..., GREEN, None]
        some = view.masks.any(axis=2, keepdims=True)
        found: NDArray[np.bool_] = np.where(some, view.masks, shown)
        return found

    def _sums(self, weights: NDArray[np.float32], lanes: NDArray[Any]) -> NDArray[Any]:
        """Return, for each green (W, S, G), the weighted sum of the lanes' values (W, N)."""
        found: NDArray[Any] = lanes @ weights.T
        return found.reshape(len(lanes), *self._shape)

    def _most(self, lanes: NDArray[Any]) -> NDArray[Any]:
        """Return, for each green (W, S, G), the largest of the values (W, N) of its lanes."""
        padded = np.pad(lanes, ((0, 0), (0, 1)))
        found: NDArray[Any] = padded[:, self._lanes].max(axis=2)
        return found.reshape(len(lanes), *self._shape)


def _dense(weights: LaneWeights, num_lanes: int) -> NDArray[np.float32]:
    """Return the weights (S · G, N)."""
    found = np.zeros((len(weights.first) - 1, num_lanes), dtype=np.float32)
    rows = np.repeat(np.arange(len(found)), np.diff(weights.first))
    found[rows, weights.lanes] = weights.weights
    return found
