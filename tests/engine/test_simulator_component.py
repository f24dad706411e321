"""Zones that other simulators run: exact simulators change no bit, faulty ones cause an error."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import cavmarl
from cavmarl.core.errors import ConfigError, ZoneSimulatorError
from cavmarl.core.extensions import REGISTERED_ZONE_SIMULATORS
from cavmarl.engine.world_description import describe_world
from cavmarl.verify.equivalence import verify_zones
from tests.support.zone_simulators import OwnKinematics, registered, step_on, steps_alike

ROOT = Path(__file__).resolve().parents[2]
ENV = "grid4x4"
SEEN: dict[str, Any] = {"agents": 4, "background": 40, "seed": 3}


def hosted(
    name: str, *zones: int, overrides: Mapping[str, Any] | None = None, **keys: Any
) -> cavmarl.CavVectorEnv:
    """Create worlds of four zones; the simulator `name` runs the given zones."""
    chosen = dict.fromkeys(zones or (1, 2), name)
    keys = {**SEEN, **keys}
    return cavmarl.make_vec(
        ENV, zones=4, zone_simulators=chosen, overrides=dict(overrides or {}), **keys
    )


def counts_of(vec: cavmarl.CavVectorEnv, world: int = 0) -> dict[str, int]:
    return dict(vec.simulation.transfers[world].counts)


def test_a_world_with_an_exact_simulator_equals_the_undivided_world(tmp_path: Path) -> None:
    journal = tmp_path / "run.jsonl"
    settings = {"zones.check_invariants": True, "zones.journal": str(journal)}
    whole = cavmarl.make_vec(ENV, **SEEN)
    with registered(OwnKinematics) as name:
        divided = hosted(name, overrides=settings)
        whole.reset(), divided.reset()
        steps_alike(whole, divided, 120)
        first, second = OwnKinematics.made
        assert divided.simulation.migrations > 10
        for one in (first, second):
            assert one.counts["spawned"] > one.counts["dropped"] > 0
            assert one.counts["driven"] > 50, "agents rarely drove in the zone"
        divided.close()
        assert first.is_closed
        assert second.is_closed
    hosts = [
        (line["zone"], line["worker"])
        for line in map(json.loads, journal.read_text().splitlines())
        if line["kind"] == "HOST"
    ]
    assert hosts == [(0, 0), (1, 2), (2, 3), (3, 0)]


def test_hosted_zones_support_sensors_messages_and_several_worlds() -> None:
    settings = {
        "v2x.enabled": True,
        "rig": {
            "gnss": {"type": "gnss", "rate_hz": 5.0},
            "lidar": {"type": "lidar", "rate_hz": 5.0, "rays": 16},
        },
        "population.mode": "respawn",
        "clock.control_latency_ticks": 2,
    }
    whole = cavmarl.make_vec(ENV, num_envs=2, overrides=settings, **SEEN)
    with registered(OwnKinematics) as name:
        divided = hosted(name, 0, 1, 2, 3, num_envs=2, overrides=settings)
        whole.reset(), divided.reset()
        steps_alike(whole, divided, 40)
        for sensor, frames in whole.frames().items():
            assert np.array_equal(frames.data, divided.frames()[sensor].data)
        whole.reset(), divided.reset()
        steps_alike(whole, divided, 10)
        assert len(OwnKinematics.made) == 8, "a reset made new simulators"
        divided.close()


def test_simulators_get_the_ghosts_and_signal_states_of_their_zone() -> None:
    compared = 0
    with registered(OwnKinematics) as name:
        vec = hosted(name, 1, overrides={"clock.ctrl_dt_s": 0.05})
        vec.reset()
        (one,) = OwnKinematics.made
        network = vec.simulation.network
        for _ in range(60):
            near = set(vec.simulation.zones.ghosts(1)["id"].tolist())
            phases, moved = vec.simulation.signal_phases(0).copy(), vec.simulation.migrations
            vec.step(vec.suggest_actions())
            if vec.simulation.migrations == moved:
                assert one.ghosts == near
                compared += len(near)
            for signal, phase in enumerate(phases):
                first = network.phases["first_state"][phase]
                codes = network.phase_states[first : first + len(one.signals[signal])]
                assert one.signals[signal] == "".join("rugGysoOY"[code] for code in codes)
        vec.close()
    assert compared > 100


class Hesitant(OwnKinematics):
    """A simulator that refuses each vehicle in the first `times` calls."""

    times = 2

    def prepare(self, vehicles: NDArray[np.void]) -> Mapping[int, str]:
        super().prepare(vehicles)
        refused = {}
        for vehicle in vehicles["id"].tolist():
            key = f"asked for {vehicle}"
            self.counts[key] += 1
            if self.counts[key] <= self.times:
                refused[vehicle] = "the place is occupied"
        return refused

    def drop(self, vehicles: Sequence[int]) -> None:
        super().drop(vehicles)
        for vehicle in vehicles:
            del self.counts[f"asked for {vehicle}"]


def test_a_refused_vehicle_stays_in_its_zone_and_is_transferred_later() -> None:
    whole = cavmarl.make_vec(ENV, **SEEN)
    settings = {
        "zones.check_invariants": True,
        "zones.max_deferred_ticks": 6,
        "zones.backoff_ticks": 0,
    }
    with registered(Hesitant) as name:
        divided = hosted(name, overrides=settings)
        whole.reset(), divided.reset()
        steps_alike(whole, divided, 80)
        counts = counts_of(divided)
        assert counts["refused"] > 4
        assert counts["deferred"] == counts["refused"]
        assert counts.get("forced", 0) == 0
        waited = {row.waited for row in divided.simulation.transfers[0].rows}
        assert waited == {0, 2}
        divided.close()


class Unwilling(Hesitant):
    times = 10**6


def test_a_simulator_that_refuses_a_vehicle_for_too_long_is_an_error() -> None:
    with registered(Unwilling) as name:
        vec = hosted(name)
        vec.reset()
        message = r"zone \d: its simulator has refused vehicle \d+.*the place is occupied"
        with pytest.raises(ZoneSimulatorError, match=message) as caught:
            step_on(vec, 200)
        assert caught.value.zone in {1, 2}
        with pytest.raises(ZoneSimulatorError, match=r"cannot continue: zone \d.*Reset it"):
            vec.step(vec.suggest_actions())
        vec.reset()
        vec.step(vec.suggest_actions())
        vec.close()
        assert all(one.is_closed for one in OwnKinematics.made)


def test_cavmarl_takes_over_a_zone_whose_simulator_refuses_vehicles_for_too_long() -> None:
    whole = cavmarl.make_vec(ENV, **SEEN)
    settings = {"zones.simulator_failure": "return", "zones.check_invariants": True}
    with registered(Unwilling) as name:
        divided = hosted(name, overrides=settings)
        whole.reset(), divided.reset()
        steps_alike(whole, divided, 80)
        assert all(one.is_closed for one in OwnKinematics.made)
        assert counts_of(divided)["forced"] > 0
        divided.close()


class Mortal(OwnKinematics):
    """The first simulator of a zone fails in call number `at` of its method `call`."""

    call = "read"
    at = 60

    def _count(self, name: str) -> None:
        self.counts[name] += 1
        earlier = [one for one in self.made if one.setup.zone == self.setup.zone]
        if name == self.call and self.counts[name] == self.at and earlier[0] is self:
            raise OSError("connection lost")

    def advance(self, wanted: NDArray[np.void], aims: NDArray[np.float64]) -> None:
        self._count("advance")
        super().advance(wanted, aims)

    def read(self) -> NDArray[np.void]:
        self._count("read")
        return super().read()

    def show(self, ghosts: NDArray[np.void], signals: Sequence[str]) -> None:
        self._count("show")
        super().show(ghosts, signals)

    def prepare(self, vehicles: NDArray[np.void]) -> Mapping[int, str]:
        self._count("prepare")
        return super().prepare(vehicles)


@pytest.mark.parametrize(
    ("call", "at", "what"),
    [
        ("advance", 60, "run a tick"),
        ("read", 60, "run a tick"),
        ("show", 60, "take its vehicles"),
        ("prepare", 2, "answer"),
    ],
)
def test_after_a_failed_call_an_error_is_raised_or_cavmarl_takes_over_the_zone(
    call: str, at: int, what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Mortal, "call", call)
    monkeypatch.setattr(Mortal, "at", at)
    whole = cavmarl.make_vec(ENV, **SEEN)
    with registered(Mortal) as name:
        vec = hosted(name, 1)
        vec.reset()
        with pytest.raises(
            ZoneSimulatorError, match=f"zone 1.*cannot {what}: OSError: connection lost"
        ):
            step_on(vec, 200)
        assert OwnKinematics.made[0].is_closed
        vec.reset(seed=3)
        whole.reset(seed=3)
        steps_alike(whole, vec, 20)
        vec.close()

        OwnKinematics.made.clear()
        journal = tmp_path / "run.jsonl"
        settings = {
            "zones.simulator_failure": "return",
            "zones.journal": str(journal),
            "zones.check_invariants": True,
        }
        vec = hosted(name, 1, overrides=settings)
        vec.reset(seed=3)
        whole.reset(seed=3)
        steps_alike(whole, vec, 60)
        assert OwnKinematics.made[0].is_closed
        vec.reset(seed=3)
        whole.reset(seed=3)
        steps_alike(whole, vec, 5)
        assert len(OwnKinematics.made) == 2, "the reset did not make a new simulator"
        vec.close()
    lines = [json.loads(line) for line in journal.read_text().splitlines()]
    of_zone = [(line["kind"], line.get("worker")) for line in lines if line.get("zone") == 1]
    hosts = [entry for entry in of_zone if entry[0] in {"HOST", "FENCE"}]
    assert hosts == [("HOST", 2), ("FENCE", None), ("HOST", 0), ("FENCE", None), ("HOST", 2)]


class Wrong(OwnKinematics):
    """A simulator that reports wrong data from its tenth tick on."""

    fault = "absent"

    def read(self) -> NDArray[np.void]:
        found = super().read()
        self.counts["read"] += 1
        if self.counts["read"] < 10 or not len(found):
            return found
        match self.fault:
            case "absent":
                return found[1:]
            case "double":
                return np.concatenate([found, found[:1]])
            case "nan":
                found["x"][0] = np.nan
            case "speed":
                found["speed"][0] += 1e-9
            case "far":
                found["y"][0] += 1.5
        return found


@pytest.mark.parametrize(
    ("fault", "tolerance_m", "message"),
    [
        ("absent", 0.0, r"reports vehicles \[.*\] instead of \["),
        ("double", 1.0, r"reports vehicles \[.*\] instead of \["),
        ("nan", 1.0, r"has moved vehicle \d+ to \(nan"),
        ("speed", 0.0, r"declares a tolerance of 0 m"),
        ("far", 1.0, r"declares a tolerance of 1 m"),
    ],
)
def test_wrong_reports_are_refused(
    fault: str, tolerance_m: float, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Wrong, "fault", fault)
    with registered(Wrong, tolerance_m) as name:
        vec = hosted(name, 1)
        vec.reset()
        with pytest.raises(ZoneSimulatorError, match=message):
            step_on(vec, 20)
        vec.close()


class Drifting(OwnKinematics):
    """A simulator that moves vehicles sideways by up to 5 cm."""

    def moved(self, row: np.void, wanted: np.void) -> np.void:
        wanted = super().moved(row, wanted)
        offset = 0.05 if self.counts["moved"] % 2 else -0.04
        wanted["x"] -= offset * np.sin(wanted["heading"])
        wanted["y"] += offset * np.cos(wanted["heading"])
        wanted["speed"] *= 0.999
        return wanted


def test_rows_have_the_positions_that_an_inexact_simulator_reports() -> None:
    with registered(Drifting, tolerance_m=0.1) as name:
        vec = hosted(name, 0, 1, 2, 3, overrides={"zones.check_invariants": True})
        vec.reset()
        aside = []
        for _ in range(100):
            vec.step(vec.suggest_actions())
            rows = vec.simulation.vehicles(0)
            assert len(set(rows["id"].tolist())) == len(rows)
            told = {v: row for one in OwnKinematics.made for v, row in one.vehicles.items()}
            for row in rows:
                if int(row["id"]) in told:
                    assert row["x"] == told[int(row["id"])]["x"]
            aside.append(np.abs(rows["d"]).mean())
            lengths = vec.simulation.network.lanes["length_m"][rows["lane"]]
            assert (rows["s"] <= lengths).all()
            assert (rows["s"] >= 0.0).all()
        assert 0.01 < np.median(aside) < 0.5
        assert vec.simulation.migrations > 10
        world = vec.worlds.world  # type: ignore[attr-defined]
        described = describe_world(world.config, world.network, world.demand, world.partition)
        assert described["zone_simulators"]["2"] == {"simulator": name, "tolerance_m": 0.1}
        vec.close()


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"zone_simulators": {4: "NAME"}}, "there is no such zone; zones are numbered from 0 to 3"),
        ({"zone_simulators": {1: "unknown"}}, "zone_simulator 'unknown': not registered"),
        ({"overrides": {"population.external": 2}}, "population.external: worlds with"),
        ({"overrides": {"zones.repartition_steps": 5}}, "set zones.repartition_steps to 0"),
        ({"zone_simulators": {1: "carla://nowhere"}}, "is not an address; use carla://HOST:PORT"),
        ({"zone_simulators": {1: "carla://a:99999"}}, "is not an address"),
        ({"zone_simulators": {1: "carla://a:1?speed=2"}}, "carla has no option 'speed'"),
        ({"zone_simulators": {1: "carla://a:1?timeout_s=nan"}}, "timeout_s = 'nan'"),
        ({"zone_simulators": {1: "carla://a:1?tolerance_m=0"}}, "tolerance_m = '0'"),
        (
            {"zone_simulators": {1: "carla://a:1", 2: "carla://a:1?timeout_s=3"}},
            "each zone needs a CARLA server of its own",
        ),
        (
            {"zone_simulators": {1: "carla://a:1"}, "num_envs": 2},
            "num_envs = 2: a CARLA server runs a zone of one world",
        ),
    ],
)
def test_the_error_for_an_unsupported_setting_names_the_setting(
    keys: dict[str, Any], message: str
) -> None:
    with registered(OwnKinematics) as name:
        simulators = keys.pop("zone_simulators", {1: name})
        named = {zone: name if text == "NAME" else text for zone, text in simulators.items()}
        with pytest.raises(ConfigError, match=re.escape(message)):
            cavmarl.make_vec(ENV, zones=4, zone_simulators=named, **SEEN, **keys)


def test_hosted_worlds_cannot_be_copied() -> None:
    with registered(OwnKinematics) as name:
        vec = hosted(name)
        vec.reset()
        with pytest.raises(ConfigError, match=r"zones\.simulators: worlds with processes"):
            copy.deepcopy(vec)
        vec.close()


def test_an_env_yaml_cannot_name_simulators(tmp_path: Path) -> None:
    (tmp_path / "env.yaml").write_text(
        "name: mine\nmap: {source: ring}\nzones: {simulators: {0: 'carla://a:1'}}\n"
    )
    with pytest.raises(ConfigError, match=r"zones\.simulators names other programs"):
        cavmarl.make_vec(tmp_path)


def test_registration_checks_names_and_tolerances() -> None:
    with pytest.raises(ConfigError, match="cavmarl has this name"):
        cavmarl.register_zone_simulator("carla", OwnKinematics)
    for tolerance_m in (-1.0, float("nan"), 1e9):
        with pytest.raises(ConfigError, match="tolerance_m"):
            cavmarl.register_zone_simulator("mine", OwnKinematics, tolerance_m=tolerance_m)


def test_the_simulator_of_the_guide_is_exact() -> None:
    text = (ROOT / "docs/guides/zone_simulators.md").read_text(encoding="utf-8")
    blocks = [part.partition("```")[0] for part in text.split("```python\n")[1:]]
    (code,) = (block for block in blocks if "register_zone_simulator" in block)
    names: dict[str, Any] = {"__name__": "guide"}
    try:
        exec(code, names)
        divided = names["vec"]
        whole = cavmarl.make_vec("ring")
        whole.reset(seed=1), divided.reset(seed=1)
        steps_alike(whole, divided, 40)
        assert divided.simulation.migrations > 0
        divided.close()
    finally:
        REGISTERED_ZONE_SIMULATORS.remove("echo")


def test_verify_zones_reports_the_tolerance_of_a_simulator() -> None:
    with registered(Drifting, tolerance_m=0.1) as name:
        found = verify_zones(
            ENV, [4], steps=5, agents=2, background=10, overrides={"zones.simulators": {1: name}}
        )
        (result,) = found.results
        assert result.tolerance_m == 0.1
        assert result.difference is None
    with registered(OwnKinematics) as name:
        found = verify_zones(
            ENV, [4], steps=5, agents=2, background=10, overrides={"zones.simulators": {1: name}}
        )
        (result,) = found.results
        assert result.tolerance_m == 0.0
        assert found.holds
