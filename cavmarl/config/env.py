"""`EnvConfig`: frozen dataclasses whose fields are the keys of `env.yaml`.

The name of a number ends with its unit, if it has one. Each class checks values and combinations
in `__post_init__`; its messages say what to change. `registry.load_config` checks types and
unknown keys when it reads a file.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from cavmarl.config.action import ActionConfig
from cavmarl.config.checks import Section, Whole, Within, check, check_finite
from cavmarl.config.limits import LimitsConfig
from cavmarl.config.population import PopulationConfig
from cavmarl.config.rig import Rig, check_rig
from cavmarl.config.road_events import RoadEvent, check_events
from cavmarl.config.scenario import ScenarioConfig
from cavmarl.config.sensors import SensorsConfig
from cavmarl.config.signals import SignalsConfig
from cavmarl.config.sumo import SumoConfig
from cavmarl.config.terms import TermsConfig
from cavmarl.config.traffic import TrafficConfig
from cavmarl.config.v2x import V2xConfig
from cavmarl.config.workers import WorkersConfig
from cavmarl.config.zones import ZonesConfig
from cavmarl.core.scene_names import is_scene_file

BY_MAP = 0.0  # this value of `horizon_s` means: derived from the map


@dataclass(frozen=True)
class MapConfig(Section, key="map"):
    """The source of the roads.

    Attributes:
        source: a map file: relative to the environment's folder, absolute, or `sumo:PATH` for a
            file of the eclipse-sumo wheel. A `.sumocfg` gives its network and signal programs. With
            a list of map files, or a folder of map files, the seed draws a map for each episode of
            each world.
        programs: additional files with signal programs, with paths as in `source`. If a signal has
            several programs, the last one runs.
        program: the program of each signal named here, instead of the last one; may be `off`.
        buildings: `osm`: the buildings in the OpenStreetMap file `source`; or a file of buildings
            (OpenStreetMap or SUMO's polygons), with a path as in `source`; empty: none.
        changed_lanes: number of lanes that may differ from the map in a world at the same time:
            closed (`close_road`), or with a lower speed limit (`damage_road`). If it is above 0,
            each world needs memory for its own tables of lanes and of routes from all lanes.
        contraflow: ids of roads that `close_road(…, contraflow=True)` can reverse. The map gets
            lanes in the opposite direction on them, which are closed until the road is reversed.
            For a reversed road, the lanes of both directions count towards `map.changed_lanes`.
        events: roads that close, open, slow down or are reversed during each episode; see
            `config.road_events.RoadEvent`.
    """

    source: str | tuple[str, ...]
    programs: tuple[str, ...] = ()
    program: dict[str, str] = field(default_factory=dict)
    buildings: str = ""
    changed_lanes: Annotated[int, Whole(0, 1_000_000)] = 0
    contraflow: tuple[str, ...] = ()
    events: tuple[RoadEvent, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        check_events(self.events, self.contraflow)
        for name in ("contraflow", "events"):
            self.need(
                "changed_lanes",
                self.changed_lanes > 0 or not getattr(self, name),
                f"map.{name} changes lanes; set this key to the number of these lanes",
            )
        self.need("source", bool(self.source) and all(self.sources), "must name a map file")
        self.need("programs", all(self.programs), "must name files")

    @property
    def sources(self) -> tuple[str, ...]:
        """The names in `source`, as a tuple."""
        return (self.source,) if isinstance(self.source, str) else self.source


@dataclass(frozen=True)
class ClockConfig(Section, key="clock"):
    """Time is counted in integer ticks; seconds = tick · sim_dt_s.

    Attributes:
        sim_dt_s: duration of a tick.
        ctrl_dt_s: duration of a step, in which an agent decides once; a whole number of ticks.
        control_latency_ticks: delay between an action and its effect.
    """

    sim_dt_s: Annotated[float, Within(0.001, 0.2)] = 0.05
    ctrl_dt_s: Annotated[float, Within(0.001, 10.0)] = 0.1
    control_latency_ticks: Annotated[int, Whole(0, 16)] = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        ticks = self.ctrl_dt_s / self.sim_dt_s
        self.need(
            "ctrl_dt_s",
            round(ticks) >= 1 and abs(ticks - round(ticks)) < 1e-9,
            f"must be a whole number of ticks of clock.sim_dt_s = {self.sim_dt_s:g}; "
            f"try {max(1, round(ticks)) * self.sim_dt_s:g}",
        )

    @property
    def ticks_per_step(self) -> int:
        """Number of ticks in a step."""
        return round(self.ctrl_dt_s / self.sim_dt_s)


@dataclass(frozen=True)
class ObservationConfig:
    """The content and the form of observations.

    Attributes:
        mode: `ground_truth`: the features configured under `sensors`, without measurement errors.
            `sensors`: the latest samples of the `rig`; keys under `sensors` have no effect.
            `messages`: only features under `sensors` that describe the ego vehicle and its route,
            or are received by radio.
        kind: `flat`: one float32 Box. `dict`: one Box per sensor.
    """

    mode: Literal["ground_truth", "sensors", "messages"] = "ground_truth"
    kind: Literal["flat", "dict"] = "flat"


@dataclass(frozen=True)
class EnvConfig(Section, key=""):
    """The decision process of one environment: all keys of `env.yaml`.

    Attributes:
        name: name of the environment, equal to the name of its folder.
        version: increases whenever published results change.
        rig: sensors that are mounted on every agent's vehicle, by name; see
            docs/reference/sensors.md.
        plugins: modules with terms, sensors, driver models and backends of users
            (docs/guides/extending.md). They are imported before the world is made.
        horizon_s: time after which an episode is truncated; 0: depends on the size of the map.
    """

    name: str
    map: MapConfig
    version: int = 0
    clock: ClockConfig = field(default_factory=ClockConfig)
    zones: ZonesConfig = field(default_factory=ZonesConfig)
    workers: WorkersConfig = field(default_factory=WorkersConfig)
    population: PopulationConfig = field(default_factory=PopulationConfig)
    traffic: TrafficConfig = field(default_factory=TrafficConfig)
    sumo: SumoConfig = field(default_factory=SumoConfig)
    action: ActionConfig = field(default_factory=ActionConfig)
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    sensors: SensorsConfig = field(default_factory=SensorsConfig)
    v2x: V2xConfig = field(default_factory=V2xConfig)
    terms: TermsConfig = field(default_factory=TermsConfig)
    signals: SignalsConfig = field(default_factory=SignalsConfig)
    limits: LimitsConfig = field(default_factory=LimitsConfig)
    rig: Rig = field(default_factory=dict)
    scenario: ScenarioConfig = field(default_factory=ScenarioConfig)
    plugins: tuple[str, ...] = ()
    horizon_s: float = 60.0

    def __post_init__(self) -> None:
        self.need("version", self.version >= 0, "must be 0 or more")
        if self.horizon_s != BY_MAP:
            self._check_horizon()
        check_rig(self.rig, self.clock.sim_dt_s, self.clock.ticks_per_step)
        for k, part in enumerate(self.population.fleet):
            unknown = [name for name in part.rig or () if name not in self.rig]
            check(
                not unknown,
                f"population.fleet.{k}.rig",
                part.rig,
                f"must name sensors of rig: {', '.join(self.rig) or 'there are none; mount some'}",
            )
        self.need(
            "workers.sensors",
            not self.workers.sensors or bool(self.rig),
            "needs sensors under rig; mount some, or set it to 0",
        )
        if self.population.external_agents:
            self._check_external_agents()
        self.need(
            "observation.mode",
            self.observation.mode != "sensors" or bool(self.rig),
            "needs a sensor under rig; mount one",
        )
        self.need(
            "population.agents",
            not self.scenario.name or self.population.agents >= 1,
            "must be 1 or more: the scenario needs agents",
        )
        if self.v2x.enabled:
            self.v2x.check_clock(self.clock.sim_dt_s)
        if self.signals.are_controlled:
            self.signals.check_clock(self.clock.sim_dt_s, self.clock.ctrl_dt_s)
            self.signals.check_messages(self.v2x)
        if self.limits.are_controlled:
            self.limits.check_clock(self.clock.ctrl_dt_s)
            self.need(
                "limits.agents",
                not self.signals.are_controlled,
                "needs signals.agents = none: a world has controlled signals or controlled limits",
            )
        self.need(
            "traffic.model",
            not (self.zones.simulators and self.traffic.networks),
            "other simulators cannot run a trained driver: leave out zones.simulators, or name a "
            "car-following model",
        )
        self._check_messages()
        if self.observation.mode == "messages":
            self._drop_sight()
        if self.traffic.source != "native":
            self._check_sumo()

    def _check_external_agents(self) -> None:
        """Raise an error if external vehicles cannot observe."""
        for key, is_met, expected in (
            ("population.external_agents", self.population.external > 0,
             "needs population.external above 0"),
            ("population.external_agents", bool(self.rig), "needs sensors under rig; mount some"),
            ("clock.ctrl_dt_s", self.clock.ticks_per_step == 1,
             "must be clock.sim_dt_s with population.external_agents: their sensors sense at the "
             "end of each step"),
        ):  # fmt: skip
            self.need(key, is_met, expected)

    def _check_horizon(self) -> None:
        """Raise an error for a horizon that is not a whole number of steps."""
        check_finite("horizon_s", self.horizon_s, self.clock.ctrl_dt_s, 1e6)
        steps = self.horizon_s / self.clock.ctrl_dt_s
        self.need(
            "horizon_s",
            abs(steps - round(steps)) < 1e-6 * steps,
            f"must be a whole number of steps of clock.ctrl_dt_s = {self.clock.ctrl_dt_s:g}; "
            f"try {max(1, round(steps)) * self.clock.ctrl_dt_s:g}",
        )

    def _drop_sight(self) -> None:
        """Switch off all sensors that see other vehicles or signals."""
        messages = self.sensors.messages
        self.need(
            "observation.mode",
            bool(messages.objects or messages.events or messages.signal),
            "no messages are observed: set sensors.messages.objects",
        )
        object.__setattr__(self, "sensors", self.sensors.without_sight())

    def _check_messages(self) -> None:
        """Raise an error if observed messages are not sent, or not kept by receivers."""
        kept = {"objects": self.v2x.inbox.objects, "events": self.v2x.inbox.events}
        for name, most in kept.items():
            key, count = f"sensors.messages.{name}", getattr(self.sensors.messages, name)
            check(
                count == 0 or self.v2x.enabled,
                key,
                count,
                "there are no messages: set v2x.enabled to true, or this to 0",
            )
            check(count <= most, key, count, f"must be at most v2x.inbox.{name} = {most}")
        for key, reads in (
            ("messages.signal", self.sensors.messages.signal),
            ("conflicts.heard", self.sensors.conflicts.heard),
        ):
            check(
                self.v2x.enabled or not reads,
                f"sensors.{key}",
                True,
                "there are no messages: set v2x.enabled to true, or this to false",
            )

    def _check_sumo(self) -> None:
        """Raise an error for settings that are impossible if SUMO provides the traffic."""
        source, tick_ms = self.traffic.source, self.clock.sim_dt_s * 1000.0
        self.need(
            "clock.sim_dt_s",
            abs(tick_ms - round(tick_ms)) < 1e-9,
            f"must be whole milliseconds with traffic.source = {source}, SUMO's unit of time",
        )
        check(
            not self.map.programs and not self.map.program,
            "map.programs",
            self.map.programs or self.map.program,
            f"traffic.source = {source}: SUMO runs the signals; name such files in its .sumocfg",
        )
        also = " and map.changed_lanes" if source == "sumo-demand" else ""
        self.need(
            "workers.balance_steps",
            not self.tells_sumo or self.workers.balance_steps == 0,
            f"must be 0 with traffic.source = {source}{also}: to move a world, SUMO would have to "
            "run again from the start of the episode",
        )
        way = self.sensors.way
        for key, timed in (
            ("sensors.signal.timing", self.sensors.signal.timing),
            ("sensors.way.timing", way.timing and way.lines > 0),
        ):
            check(
                not timed,
                key,
                True,
                f"traffic.source = {source}: SUMO's signal changes are not known; set it to false",
            )
        self.need(
            "map.contraflow",
            not self.map.contraflow,
            f"traffic.source = {source}: SUMO has no contraflow lanes; leave the key out, or use "
            "traffic.source = native",
        )
        self.need(
            "signals.overrides",
            self.signals.overrides == 0,
            f"traffic.source = {source}: SUMO runs the signals; leave the key out",
        )
        self.need(
            "signals.agents",
            not self.signals.are_controlled,
            f"traffic.source = {source}: SUMO runs the signals; leave the key out",
        )
        self.need(
            "limits.agents",
            not self.limits.are_controlled,
            f"traffic.source = {source}: SUMO would not see the limits; leave the key out",
        )
        self.need(
            "scenario.name",
            not is_scene_file(self.scenario.name),
            f"traffic.source = {source}: a logged scene has traffic of its own; name a scripted "
            "scenario, or use traffic.source = native",
        )

    @property
    def registered(self) -> tuple[str, ...]:
        """The registered extensions that the environment may use."""
        simulators = (text.partition("://")[0] for text in self.zones.simulators.values())
        return (*self.terms.registered, *self.sensors.registered, *self.traffic.models, *simulators)

    @property
    def may_change_lanes(self) -> bool:
        """Whether lanes of a world may differ from the map: closed, or with a lower limit."""
        return self.map.changed_lanes > 0 or self.limits.are_controlled

    @property
    def tells_sumo(self) -> bool:
        """Whether SUMO receives commands during an episode, so that it deviates from its demand.

        SUMO receives changed lanes and, with `sumo-traffic`, also the vehicles that cavmarl moves.
        """
        source = self.traffic.source
        return source == "sumo-traffic" or (source != "native" and self.may_change_lanes)

    @property
    def drives_alone(self) -> bool:
        """Whether only the vehicles of a demand drive, so that only the horizon ends an episode."""
        return self.population.agents == 0 and bool(self.traffic.demand)

    @property
    def controlled(self) -> SignalsConfig | LimitsConfig | None:
        """The signals or the limits that are controlled, by agents or by a controller."""
        if self.signals.are_controlled:
            return self.signals
        return self.limits if self.limits.are_controlled else None

    @property
    def roadside(self) -> SignalsConfig | LimitsConfig | None:
        """The signals or the limits that agents control."""
        found = self.controlled
        return found if found is not None and found.have_agents else None

    def refusal_of_agents(self, what: str) -> str:
        """Return why `what` cannot have agents of signals or limits; empty without such agents."""
        return "" if self.roadside is None else self.roadside.refusal_of_agents(what)

    @property
    def max_steps(self) -> int:
        """Steps until truncation; valid if the horizon is known."""
        return max(1, round(self.horizon_s / self.clock.ctrl_dt_s))
