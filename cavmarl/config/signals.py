"""`SignalsConfig`: signals that agents or the caller control."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from cavmarl.config.checks import Section, Whole, Within, check_finite
from cavmarl.config.v2x import V2xConfig
from cavmarl.core.errors import ConfigError

# The named terms of a signal's reward, in the order of every array of signal terms
# (`signals/kernels/signal_observations.py`).
SIGNAL_TERMS = ("diff_wait", "average_speed", "queue", "pressure", "delay", "wait")

NO_SIGNALS = "none"
ALL_SIGNALS = "all"

BY_AGENTS: Literal["agents"] = "agents"
SIGNAL_CONTROLLERS = (
    "program",
    "webster",
    "actuated",
    "sotl",
    "longest_queue",
    "max_pressure",
)  # see `signals.controllers`
WITH_LONGEST_RED = ("longest_queue", "max_pressure")  # controllers that read `longest_red_s`


@dataclass(frozen=True)
class SignalsConfig(Section, key="signals"):
    """The signals whose greens are chosen; docs/reference/signal_agents.md describes the API.

    Attributes:
        agents: `none`; `all` signals with two or more greens; or a list of ids of signals. Other
            signals keep their programs.
        controller: what chooses the greens of these signals: `agents` of the environment, or one of
            `SIGNAL_CONTROLLERS`; then all agents are vehicles.
        decide_s: time between two decisions; a whole number of steps of `clock.ctrl_dt_s`.
        yellow_s: duration of yellow between two greens.
        all_red_s: duration of red for all links, between yellow and the next green.
        min_green_s: a green lasts at least this long.
        max_green_s: at a decision, a green that has lasted this long ends; 0: no maximum.
        longest_red_s: `longest_queue` and `max_pressure` first choose a green for a lane that has
            been red this long while a vehicle waits; 0: off.
        saturation_per_h: `webster`: vehicles per hour of green that leave a lane.
        flow_interval_s: `webster` plans from the vehicles counted in the last interval of this
            length.
        max_gap_s: `actuated` ends a green if its detectors have been free for this long.
        sotl_vehicle_s: `sotl` ends a green if vehicles on the red lanes of another green have
            waited this long in total.
        platoon: `sotl` keeps a green while 1 to this number of vehicles are near its lines; 0: off.
        platoon_m: distance from the line within which these vehicles are counted.
        greens: which phases of a program are greens. `distinct`: those with a green and no yellow
            letter for vehicles; phases with equal letters count once. `all`: as in sumo-rl, each
            phase without the letter `y` that has any letter but `r` and `s`.
        action: `next_phase`: the index of the next green. `keep_or_next`: 0 keeps the green, 1
            begins the next one in the order of the program.
        forbidden: a choice that the action mask excludes is ignored and counted (`ignore`), or is
            an ActionError (`error`).
        range_m: how far before the stop line scores of controllers and rewards count vehicles. A
            lane of which a part is within this distance counts completely. 0: only the last lane
            before the signal counts, as in sumo-rl. Needs `sensing: truth`.
        terms: weights of the reward's terms; see `SIGNAL_TERMS`.
        sensing: what agents and controllers know of the vehicles: `truth`; the induction `loops` of
            the lanes; what the `camera` of a signal sees; or `v2x`, messages that its roadside unit
            has received. Rewards always use the truth.
        loop_upstream_m: distance from the stop line to the loop before it.
        camera_range_m: range of a camera, measured from the signal along a lane.
        camera_height_m: height of a camera above the road.
        camera_misses: probability that a camera misses a vehicle at a decision.
        overrides: number of links whose signal state the caller may override in a world at the same
            time (`SignalOverrides`).
    """

    agents: str | tuple[str, ...] = NO_SIGNALS
    controller: Literal[
        "agents", "program", "webster", "actuated", "sotl", "longest_queue", "max_pressure"
    ] = BY_AGENTS
    decide_s: Annotated[float, Within(0.001, 3600.0)] = 5.0
    yellow_s: Annotated[float, Within(0.0, 60.0)] = 2.0
    all_red_s: Annotated[float, Within(0.0, 60.0)] = 0.0
    min_green_s: Annotated[float, Within(0.0, 3600.0)] = 5.0
    max_green_s: Annotated[float, Within(0.0, 3600.0)] = 60.0
    longest_red_s: Annotated[float, Within(0.0, 3600.0)] = 0.0
    saturation_per_h: Annotated[float, Within(100.0, 10_000.0)] = 1800.0
    flow_interval_s: Annotated[float, Within(1.0, 86400.0)] = 300.0
    max_gap_s: Annotated[float, Within(0.1, 60.0)] = 3.0
    sotl_vehicle_s: Annotated[float, Within(0.1, 100_000.0)] = 40.0
    platoon: Annotated[int, Whole(0, 1000)] = 3
    platoon_m: Annotated[float, Within(0.0, 1000.0)] = 25.0
    greens: Literal["distinct", "all"] = "distinct"
    action: Literal["next_phase", "keep_or_next"] = "next_phase"
    forbidden: Literal["ignore", "error"] = "ignore"
    range_m: Annotated[float, Within(0.0, 1000.0)] = 0.0
    terms: dict[str, float] = field(default_factory=lambda: {"diff_wait": 1.0})
    sensing: Literal["truth", "loops", "camera", "v2x"] = "truth"
    loop_upstream_m: Annotated[float, Within(5.0, 1000.0)] = 50.0
    camera_range_m: Annotated[float, Within(1.0, 1000.0)] = 50.0
    camera_height_m: Annotated[float, Within(1.0, 100.0)] = 8.0
    camera_misses: Annotated[float, Within(0.0, 1.0)] = 0.0
    overrides: Annotated[int, Whole(0, 100_000)] = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.need(
            "range_m",
            self.range_m == 0.0 or self.sensing == "truth",
            f"must be 0 with signals.sensing = {self.sensing}, whose sensors are on the last lanes",
        )
        self.need(
            "agents",
            self.agents in (NO_SIGNALS, ALL_SIGNALS) or isinstance(self.agents, tuple),
            "must be none, all, or a list of ids of signals",
        )
        self.need("agents", len(self.agents) > 0, "names no signal; use none")
        self.need(
            "agents",
            isinstance(self.agents, str) or len(set(self.agents)) == len(self.agents),
            "names a signal twice",
        )
        self.need(
            "max_green_s",
            self.max_green_s == 0.0 or self.max_green_s >= self.min_green_s,
            f"must be 0, or at least signals.min_green_s = {self.min_green_s:g}",
        )
        self.need(
            "longest_red_s",
            self.longest_red_s == 0.0 or self.controller in (BY_AGENTS, *WITH_LONGEST_RED),
            f"has no effect on signals.controller = {self.controller}, only on "
            f"{' and '.join(WITH_LONGEST_RED)}; set it to 0, or choose one of these",
        )
        for name, weight in self.terms.items():
            if name not in SIGNAL_TERMS:
                raise ConfigError(
                    f"signals.terms = {name!r}: no such term; must be one of "
                    f"{', '.join(SIGNAL_TERMS)}"
                )
            check_finite(f"signals.terms.{name}", weight, -1e6, 1e6)

    @property
    def are_controlled(self) -> bool:
        """Whether the greens of any signal are chosen."""
        return self.agents != NO_SIGNALS

    @property
    def have_agents(self) -> bool:
        """Whether agents of the environment choose the greens."""
        return self.are_controlled and self.controller == BY_AGENTS

    def refusal_of_agents(self, what: str) -> str:
        """Return why `what` does not support agents at signals; empty without such agents."""
        if not self.have_agents:
            return ""
        choices = ", ".join(SIGNAL_CONTROLLERS)
        return (
            f"signals.agents = {self.agents!r}: {what} has only vehicles as agents; set "
            f"signals.controller to one of {choices}, or use make_vec, parallel_env or an adapter "
            "of TorchRL, BenchMARL or RLlib"
        )

    @property
    def weight_of_each(self) -> tuple[float, ...]:
        """The weights of all terms, in the order of `SIGNAL_TERMS`."""
        return tuple(self.terms.get(name, 0.0) for name in SIGNAL_TERMS)

    def check_clock(self, sim_dt_s: float, ctrl_dt_s: float) -> None:
        """Raise a ConfigError for a time that is not a whole number of ticks or of steps."""
        for name in (
            "yellow_s", "all_red_s", "min_green_s", "max_green_s", "longest_red_s",
            "flow_interval_s",
        ):  # fmt: skip
            self._check_multiple(name, "ticks of clock.sim_dt_s", sim_dt_s)
        self._check_multiple("decide_s", "steps of clock.ctrl_dt_s", ctrl_dt_s)

    def check_messages(self, v2x: V2xConfig) -> None:
        """Raise a ConfigError if signals need messages, but vehicles do not send any."""
        self.need(
            "sensing",
            self.sensing != "v2x" or (v2x.enabled and v2x.cam.rate_hz > 0.0),
            "vehicles send no messages: set v2x.enabled to true, v2x.cam.rate_hz above 0, and "
            "v2x.roadside.signals to [all]",
        )

    def _check_multiple(self, name: str, unit: str, unit_s: float) -> None:
        ratio = getattr(self, name) / unit_s
        self.need(
            name,
            abs(ratio - round(ratio)) < 1e-6 and (name != "decide_s" or round(ratio) >= 1),
            f"must be a whole number of {unit} = {unit_s:g}; try {max(1, round(ratio)) * unit_s:g}",
        )
