"""Options of SUMO's configurations that concern demand and time."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from cavmarl.core.errors import DemandError
from cavmarl.roads.sumo_net.sumo_options import (
    GivenOption,
    differs_from_default,
    files_of,
    known_options,
    read_options,
)
from cavmarl.traffic.demand.demand_records import CODES
from cavmarl.traffic.demand.element import DemandReport, Element
from cavmarl.traffic.demand.rerouting_device import DeviceOptions

MAX_SCALE = 1000.0

# Reasons why options are ignored, by kind or name; other options are "not modelled".
_REASONS = {
    "seed": "is not used; the world's own seed is used instead",
    "unread": "is not read",
    "step-length": "is not used; a tick lasts `clock.sim_dt_s`",
    "time-to-teleport": "is not modelled: no vehicle is teleported",
}


@dataclass(frozen=True)
class SumoConfigFile:
    """The settings of a configuration that concern demand and time."""

    files: tuple[Path, ...] = ()  # additional files, then route files, in SUMO's order of reading
    begin_ms: int | None = None  # start of the simulation; None: not given
    end_ms: int = -1  # end of the simulation; -1: when the demand has ended
    step_ms: int = 1000  # length of a step
    # options of the rerouting device
    rerouting: DeviceOptions = field(default_factory=DeviceOptions)
    # default attributes of departures and of types
    departs: Mapping[str, str] = field(default_factory=dict)
    types: Mapping[str, str] = field(default_factory=dict)
    scale: float = 1.0  # factor on the number of departures
    skips_bad_routes: bool = False  # whether vehicles that cannot drive their route are left out


def read_sumo_config(path: Path, report: DemandReport | None = None) -> SumoConfigFile:
    """Read a configuration of SUMO; `report` counts the ignored options.

    Raises DemandError: the file is missing or is not a SUMO configuration, SUMO has no such option,
    an option is set twice, a named file does not exist, or a value is invalid.
    """
    given = read_options(path, DemandError)
    if report is not None:
        tell_ignored(path, given, report)
    options = {
        name: Element(name, {"value": option.value}, str(path), option.line)
        for name, option in given.items()
    }

    def time_ms(name: str) -> int | None:
        element = options.get(name)
        # -1 means no end in SUMO.
        if element is None or (name == "end" and element.attrs["value"].startswith("-1")):
            return None
        return element.time_ms("value")

    end_ms = time_ms("end")
    step_ms = time_ms("step-length")
    if step_ms == 0:
        raise options["step-length"].error("is not a valid step length", "write seconds above 0")
    scale = options.get("scale")
    skips = options.get("ignore-route-errors")
    return SumoConfigFile(
        files=tuple(files_of(path, given, ["additional-files", "route-files"], DemandError)),
        begin_ms=time_ms("begin"),
        end_ms=-1 if end_ms is None else end_ms,
        step_ms=1000 if step_ms is None else step_ms,
        rerouting=DeviceOptions.of(options),
        departs=_departs(options),
        types=_types(options),
        scale=1.0 if scale is None else scale.number("value", 1.0, least=0.0, most=MAX_SCALE),
        skips_bad_routes=skips is not None and skips.flag("value", False),
    )


def tell_ignored(
    path: Path,
    given: Mapping[str, GivenOption],
    report: DemandReport,
    ignored: Collection[str] = ("time", "seed", "traffic", "unread"),
) -> None:
    """Count the options of a configuration that change traffic but are ignored.

    `ignored`: kinds of options that are ignored; begin and end are never ignored.
    """
    for name, option in given.items():
        known = known_options()[name]
        if known.kind not in ignored or name in ("begin", "end"):
            continue
        if name == "time-to-teleport":
            differs = not option.value.startswith("-") and option.value.strip("0:.") != ""
        else:
            differs = name == "step-length" or differs_from_default(known, option.value)
        if differs:
            reason = _REASONS.get(name, _REASONS.get(known.kind, "is not modelled"))
            what = f"option {name} = {option.value} {reason}"
            report.tolerate(what, f"{path}, line {option.line}")


def _departs(options: Mapping[str, Element]) -> dict[str, str]:
    """Return the attributes of departures that a configuration sets for all vehicles."""
    found = {}
    for key in ("departLane", "departSpeed"):
        element = options.get(f"default.{key.lower()}")
        if element is None:
            continue
        found[key] = element.attrs["value"].strip()
        if found[key] not in CODES[key]:
            element.number("value", 0.0, least=0.0, words=CODES[key])
    return found


def _types(options: Mapping[str, Element]) -> dict[str, str]:
    """Return the default attributes of types that a configuration sets."""
    found = {}
    model, deviation = options.get("default.carfollowmodel"), options.get("default.speeddev")
    if model is not None:
        found["carFollowModel"] = model.attrs["value"]
    # SUMO's default -1 stands for the deviation of the class.
    if deviation is not None and deviation.number("value", -1.0) >= 0.0:
        found["speedDev"] = deviation.attrs["value"]
    return found
