"""Times of signal changes in messages, and the driver `glosa`, which uses them."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.glosa import ADVISED, drive, measure
from cavmarl import ConfigError, load_policy, make_vec
from cavmarl.core.errors import PolicyError
from cavmarl.engine.spaces import observation_parts
from tests.support.actuated import actuated_grid

KNOWN, GO, LINE, CHANGE, RETURN = 0, 1, 4, 5, 6


def signal_data(env: str | Path, steps: int, **settings: Any) -> NDArray[np.float64]:
    """Return what agents know of their next signal in each step, (steps, agents, 9).

    Columns 0 to 6 are from messages, in m and s. Columns 7 and 8 are the true distance to the line
    in m, and the true time to the change of its letter in s.
    """
    keys = {**ADVISED} | {"clock.ctrl_dt_s": 0.2, "sensors.signal.range_m": 200.0} | settings
    keys |= {"sensors.signal.timing": True}
    vec = make_vec(env, num_envs=1, agents=8, background=0, overrides=keys)
    parts = observation_parts(vec.config.sensors)
    messages, signal = parts["messages"].place, parts["signal"].place
    observations, _ = vec.reset(seed=3)
    found = []
    for _ in range(steps):
        observations, *_ = vec.step(vec.suggest_actions())
        heard = observations[0, :, messages.stop - 7 : messages.stop].astype(np.float64)
        seen = observations[0, :, signal.stop - 2].astype(np.float64)
        far = observations[0, :, signal.start + 1].astype(np.float64) * 200.0
        heard[:, LINE] *= 300.0
        with np.errstate(divide="ignore"):
            heard[:, [CHANGE, RETURN]] = 5.0 / heard[:, [CHANGE, RETURN]] - 5.0
            found.append(np.column_stack([heard, far, 5.0 / seen - 5.0]))
    return np.array(found)


def test_the_times_of_the_next_two_changes_are_correct() -> None:
    heard = signal_data("grid4x4", 400)
    tick_s = 0.06  # messages may be a tick old
    changes = steps = 0
    is_known = (heard[..., KNOWN] > 0.0) & (heard[..., 7] > 0.0)
    np.testing.assert_allclose(heard[is_known, LINE], heard[is_known, 7], atol=1e-3)
    # While a signal is green, compare its change with the true time.
    ends = is_known & (heard[..., GO] > 0.0) & (heard[..., CHANGE] > tick_s)
    np.testing.assert_allclose(heard[ends, CHANGE], heard[ends, 8], atol=tick_s)
    for before, after in pairwise(heard):
        same = (before[:, KNOWN] > 0.0) & (after[:, KNOWN] > 0.0)
        same &= np.abs(before[:, LINE] - after[:, LINE]) < 5.0
        flips = same & (before[:, GO] != after[:, GO])
        steady = same & ~flips & (after[:, CHANGE] > tick_s)
        drop = before[steady][:, [CHANGE, RETURN]] - after[steady][:, [CHANGE, RETURN]]
        np.testing.assert_allclose(drop, 0.2, atol=tick_s)
        assert (before[flips, CHANGE] < 0.2 + tick_s).all()
        np.testing.assert_allclose(before[flips, RETURN] - after[flips, CHANGE], 0.2, atol=tick_s)
        changes += int(flips.sum())
        steps += int(steady.sum())
    assert changes > 20
    assert steps > 1000


def test_actuated_signals_report_the_earliest_times(tmp_path: Path) -> None:
    heard = signal_data(actuated_grid(tmp_path), 300)
    ahead = (heard[:-1, :, KNOWN] > 0.0) & (np.abs(heard[:-1, :, LINE] - heard[1:, :, LINE]) < 5.0)
    ahead &= heard[1:, :, KNOWN] > 0.0
    flips = ahead & (heard[:-1, :, GO] != heard[1:, :, GO])
    assert flips.sum() > 5
    assert (heard[:-1][flips][:, CHANGE] < 0.3).all()
    assert np.isfinite(heard[heard[..., KNOWN] > 0.0][:, [CHANGE, RETURN]]).all()


@pytest.mark.parametrize("min_green_s", [4.0, 10.0])
def test_signals_with_agents_report_the_earliest_change(min_green_s: float) -> None:
    keys = {
        "signals.agents": "all",
        "signals.controller": "max_pressure",
        "signals.min_green_s": min_green_s,
    }
    heard = signal_data("grid4x4", 400, **keys)
    is_known = heard[..., KNOWN] > 0.0
    assert np.isinf(heard[is_known][:, RETURN]).all()
    assert np.isfinite(heard[is_known][:, CHANGE]).all()
    assert (heard[is_known, LINE] > 0.0).all()
    assert heard[is_known][:, CHANGE].max() > min_green_s
    tick_s = 0.06  # messages may be a tick old
    before, after = heard[:-1], heard[1:]
    same = (before[..., KNOWN] > 0.0) & (after[..., KNOWN] > 0.0)
    same &= np.abs(before[..., LINE] - after[..., LINE]) < 5.0
    flips = same & (before[..., GO] != after[..., GO])
    assert flips.sum() > 20
    assert (before[flips][:, CHANGE] < 0.2 + tick_s).all()
    steady = same & ~flips  # the earliest time cannot decrease faster than time passes
    passed_s = before[steady][:, CHANGE] - after[steady][:, CHANGE]
    assert (passed_s < 0.2 + tick_s).all()


def test_glosa_reduces_stops_at_almost_the_same_speed() -> None:
    advised, plain = drive("glosa", agents=12), drive("idm", agents=12)
    assert plain.stops > 100
    assert advised.stops < 0.65 * plain.stops
    assert advised.stood_s < 0.7 * plain.stood_s
    assert advised.distance_m > 0.95 * plain.distance_m
    assert advised.co2_g < plain.co2_g


def test_without_messages_glosa_drives_like_idm() -> None:
    deaf = {"v2x.channel.loss": 1.0}
    found = (drive(name, agents=12, seconds=60, overrides=deaf) for name in ("glosa", "idm"))
    assert len(set(found)) == 1


def test_the_benchmark_has_a_row_for_each_driver() -> None:
    rows = measure(agents=[2], worlds=1, seconds=20).rows
    assert [(row["driver"], row["agents"]) for row in rows] == [("idm", 2), ("glosa", 2)]


def test_the_error_names_missing_requirements() -> None:
    with pytest.raises(PolicyError, match=r"glosa needs .* overrides=.*v2x\.roadside\.signals"):
        load_policy("glosa", make_vec("grid4x4", agents=1, background=0))
    with pytest.raises(ConfigError, match=r"sensors\.messages\.timing.*needs sensors\.messages\.s"):
        make_vec("grid4x4", overrides={"v2x.enabled": True, "sensors.messages.timing": True})
