"""Clock drift of an official CARLA client: Table II of the co-simulation paper.

An own tick is a tick that the client requests although another caller is the time master.
"""

from __future__ import annotations

import pytest

from benchmarks.carla_clock import measure_client_drift
from cavmarl.config.world_spec import WorldSpec
from cavmarl.cosim.carla.carla_session import OtherTicks
from cavmarl.handoff.simulators.carla_zone import PYTHON
from tests.cosim.carla.conftest import client_python

pytest.importorskip("libsumo", reason="needs the extra 'sumo'")

SPEC = WorldSpec.of("grid4x4", agents=2, background=0, seed=0)


@pytest.mark.parametrize("other_ticks", ["obey", "refuse", "follow"])
def test_own_ticks_of_a_client_are_counted_and_can_be_refused(
    other_ticks: OtherTicks, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PYTHON, client_python("0.9.16"))
    found = measure_client_drift(SPEC, steps=100, rogue=0.92, other_ticks=other_ticks, sumo=20)
    (row,) = found.rows
    assert (found.own_ticks, found.counted) == (92, 92)
    assert row.master_s == 5.0
    if other_ticks == "obey":
        assert row.delta_s == pytest.approx(4.6)
        assert row.ratio == 1.92
        assert (
            found.drift_events == 91
        )  # the drift after the last own tick is not seen, because no step follows
        assert found.noticed_ticks == 1
    else:
        assert (row.delta_s, row.ratio) == (0.0, 1.0)
        assert found.drift_events == 0
    assert found.holds


def test_a_client_without_own_ticks_does_not_drift(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PYTHON, client_python("0.9.16"))
    found = measure_client_drift(SPEC, steps=60, sumo=20)
    assert (found.own_ticks, found.counted, found.drift_events) == (0, 0, 0)
    assert {row.ratio for row in found.rows} == {1.0}
    assert found.holds
