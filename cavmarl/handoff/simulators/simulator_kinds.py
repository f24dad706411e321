"""The simulators that can run zones: their registration, and how `zones.simulators` names them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple
from urllib.parse import parse_qsl

from cavmarl.config.rig import MountedConfig
from cavmarl.core.errors import ConfigError
from cavmarl.core.extensions import REGISTERED_ZONE_SIMULATORS
from cavmarl.handoff.simulators import carla_frames, carla_zone
from cavmarl.handoff.simulators.zone_simulator import MakeSimulator, number_option

CARLA = "carla"
MOST_TOLERANCE_M = 20.0


class SimulatorKind(NamedTuple):
    """A kind of simulator.

    Attributes:
        make: makes the simulator of one zone of one world.
        tolerance_m: largest distance between the place that the simulator reports and the place
            where cavmarl would have moved the vehicle in the same tick; 0: the places are equal.
    """

    make: MakeSimulator
    tolerance_m: float


class HostedZone(NamedTuple):
    """A zone that another simulator runs, as `zones.simulators` describes it."""

    zone: int
    text: str  # NAME, or NAME://PLACE?OPTION=VALUE&…
    kind: SimulatorKind
    place: str
    options: dict[str, str]
    tolerance_m: float

    def check_rig(self, rig: Mapping[str, MountedConfig]) -> None:
        """Raise ConfigError if the simulator cannot take the samples that its options require."""
        if self.is_single:
            carla_frames.check_rig(self.zone, self.options, rig)

    @property
    def is_single(self) -> bool:
        """True if the simulator can run a zone of one world only."""
        return self.kind.make is carla_zone.make


def register_zone_simulator(name: str, make: MakeSimulator, *, tolerance_m: float = 0.0) -> None:
    """Register a simulator that can run zones, for `zone_simulators` of `make_vec`.

    Args:
        name: name in `zone_simulators={2: name}` or `{2: "name://PLACE?OPTION=VALUE"}`.
        make: makes the simulator of one zone of one world.
        tolerance_m: 0 if the simulator moves vehicles exactly as cavmarl does, so that a world that
            uses it equals the undivided world bit for bit. Otherwise the largest distance between
            the reported place and the place where cavmarl would have moved the vehicle in the same
            tick.

    Raises:
        ConfigError: the name is not an identifier, or is taken; or the tolerance is not valid.
    """
    if not 0.0 <= tolerance_m <= MOST_TOLERANCE_M:  # false for NaN
        raise ConfigError(
            f"zone_simulator '{name}': tolerance_m = {tolerance_m!r}: must be from 0 to "
            f"{MOST_TOLERANCE_M:g}"
        )
    REGISTERED_ZONE_SIMULATORS.add(name, SimulatorKind(make, tolerance_m), make, (CARLA,))


def hosted_zones(simulators: Mapping[int, str], num_zones: int) -> tuple[HostedZone, ...]:
    """Read `zones.simulators`, in the order of zones.

    Raises:
        ConfigError: there is no such zone or simulator, or an option is not valid.
    """
    found: list[HostedZone] = []
    for zone, text in sorted(simulators.items()):
        if not 0 <= zone < num_zones:
            raise ConfigError(
                f"zones.simulators.{zone}: there is no such zone; zones are numbered from 0 to "
                f"{num_zones - 1}"
            )
        found.append(_read(zone, text))
    places = [one.place for one in found if one.is_single]
    if len(set(places)) < len(places):
        raise ConfigError("zones.simulators: each zone needs a CARLA server of its own")
    return tuple(found)


def check_servers(hosted: Sequence[HostedZone], num_worlds: int) -> None:
    """Raise ConfigError if a server for a single world would have to run several worlds."""
    if num_worlds > 1 and any(one.is_single for one in hosted):
        raise ConfigError(
            f"num_envs = {num_worlds}: a CARLA server runs a zone of one world; set num_envs = 1"
        )


def _read(zone: int, text: str) -> HostedZone:
    name, _, rest = text.partition("://")
    place, _, query = rest.partition("?")
    options = dict(parse_qsl(query))
    if name != CARLA:
        kind: SimulatorKind = REGISTERED_ZONE_SIMULATORS[name]
        return HostedZone(zone, text, kind, place, options, kind.tolerance_m)
    carla_zone.check(place, options)
    tolerance_m = number_option(options, "tolerance_m", carla_zone.TOLERANCE_M, MOST_TOLERANCE_M)
    kind = SimulatorKind(carla_zone.make, tolerance_m)
    return HostedZone(zone, text, kind, place, options, tolerance_m)


def describe_simulators(simulators: Mapping[int, str], num_zones: int) -> dict[str, Any]:
    """Return the simulators and their tolerances by zone, for manifests."""
    return {
        str(one.zone): {"simulator": one.text, "tolerance_m": one.tolerance_m}
        for one in hosted_zones(simulators, num_zones)
    }
