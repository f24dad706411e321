"""What a world is: `EnvConfig`, frozen dataclasses whose fields are the keys of `env.yaml`.

A unit ends the name of every bare number. Each class refuses, in `__post_init__`, the values and
the combinations that cannot work, and says what to change. Types and unknown keys are checked at
the border by `registry.load_config`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from cavmarl.config.action import ActionConfig
from cavmarl.config.checks import Section, Whole, Within, check, check_finite
from cavmarl.config.population import PopulationConfig
from cavmarl.config.rig import Rig, check_rig
from cavmarl.config.scenario import ScenarioConfig
from cavmarl.config.sensors import SensorsConfig
from cavmarl.config.sumo import SumoConfig
from cavmarl.config.terms import TermsConfig
from cavmarl.config.traffic import TrafficConfig
from cavmarl.config.v2x import V2xConfig
from cavmarl.config.workers import WorkersConfig
from cavmarl.config.zones import ZonesConfig

BY_MAP = 0.0  # a horizon in s that the map says


@dataclass(frozen=True)
class MapConfig(Section, key="map"):
    """Where the roads come from.

    Attributes:
        source: a map file: relative to the entry's folder, absolute, or `sumo:PATH` for a file of
            the eclipse-sumo wheel. A list of them, or a folder of map files: each episode of each
            world is on one that is drawn by the seed.
        programs: additional files with more signal programs, named as the source is; of several
            programs of a signal the last is on.
        program: the program of each signal named here, whatever was loaded; `off` is one, too.
        buildings: `osm`: those of the OpenStreetMap file that `source` is; or a file of buildings
            (OpenStreetMap or SUMO's polygons), named as the source is; empty: none.
    """

    source: str | tuple[str, ...]
    programs: tuple[str, ...] = ()
    program: dict[str, str] = field(default_factory=dict)
    buildings: str = ""

    def __post_init__(self) -> None:
        self.need("source", bool(self.source) and all(self.sources), "must name a map file")
        self.need("programs", all(self.programs), "must name files")

    @property
    def sources(self) -> tuple[str, ...]:
        """What `source` names, one or several."""
        return (self.source,) if isinstance(self.source, str) else self.source


@dataclass(frozen=True)
class ClockConfig(Section, key="clock"):
    """Time: the integer tick is the truth, seconds = tick · sim_dt_s.

    Attributes:
        sim_dt_s: seconds a tick.
        ctrl_dt_s: seconds an agent's decision (step); a whole number of ticks.
        control_latency_ticks: ticks between an action and its effect.
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
        """Ticks in one agent step."""
        return round(self.ctrl_dt_s / self.sim_dt_s)


@dataclass(frozen=True)
class ObservationConfig:
    """What an observation is made of, and its form.

    Attributes:
        mode: `ground_truth`: what `sensors` says, taken from the world itself. `sensors`: the
            latest samples of the `rig`. `messages`: of `sensors` only what the vehicle knows of
            itself and its route, and what it is told over the air.
        kind: `flat`: one Box of float32. `dict`: one Box a sensor.
    """

    mode: Literal["ground_truth", "sensors", "messages"] = "ground_truth"
    kind: Literal["flat", "dict"] = "flat"


@dataclass(frozen=True)
class EnvConfig(Section, key=""):
    """The whole decision process of one environment: the keys of `env.yaml`.

    Attributes:
        name: of the entry, as its folder.
        version: goes up whenever results change that others may have reported.
        rig: sensors that are mounted on every agent's vehicle, by name; see
            docs/reference/sensors.md.
        horizon_s: when an episode is truncated; 0: after a time by the size of the map.
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
    rig: Rig = field(default_factory=dict)
    scenario: ScenarioConfig = field(default_factory=ScenarioConfig)
    horizon_s: float = 60.0

    def __post_init__(self) -> None:
        self.need("version", self.version >= 0, "must be 0 or more")
        if self.horizon_s != BY_MAP:
            self._check_horizon()
        check_rig(self.rig, self.clock.sim_dt_s, self.clock.ticks_per_step)
        self.need(
            "workers.sensors",
            not self.workers.sensors or bool(self.rig),
            "there is no rig whose sensors they could share; name some under rig, or leave it 0",
        )
        self.need(
            "observation.mode",
            self.observation.mode != "sensors" or bool(self.rig),
            "there is no sensor under rig; mount one",
        )
        self.need(
            "population.agents",
            not self.scenario.name or self.population.agents >= 1,
            "must be 1 or more where there is a scenario: it is played to agents",
        )
        if self.v2x.enabled:
            self.v2x.check_clock(self.clock.sim_dt_s)
        self._check_messages()
        if self.observation.mode == "messages":
            self._keep_what_is_told()
        if self.traffic.source != "native":
            self._check_sumo()

    def _check_horizon(self) -> None:
        """Refuse a horizon that is no number of steps."""
        check_finite("horizon_s", self.horizon_s, self.clock.ctrl_dt_s, 1e6)
        steps = self.horizon_s / self.clock.ctrl_dt_s
        self.need(
            "horizon_s",
            abs(steps - round(steps)) < 1e-6 * steps,
            f"must be a whole number of steps of clock.ctrl_dt_s = {self.clock.ctrl_dt_s:g}; "
            f"try {max(1, round(steps)) * self.clock.ctrl_dt_s:g}",
        )

    def _keep_what_is_told(self) -> None:
        """Switch the sensors off that look at others."""
        told = self.sensors.messages
        self.need(
            "observation.mode",
            bool(told.objects or told.events or told.signal),
            "no messages are observed: set sensors.messages.objects",
        )
        object.__setattr__(self, "sensors", self.sensors.without_sight())

    def _check_messages(self) -> None:
        """Refuse to observe messages that are not kept."""
        kept = {"objects": self.v2x.inbox.objects, "events": self.v2x.inbox.events}
        for name, most in kept.items():
            key, count = f"sensors.messages.{name}", getattr(self.sensors.messages, name)
            check(
                count == 0 or self.v2x.enabled,
                key,
                count,
                "there are no messages: set v2x.enabled to true, or this to 0",
            )
            check(count <= most, key, count, f"v2x.inbox.{name} = {most} keeps fewer")
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
        """Refuse what cannot be together with SUMO as global traffic."""
        source, tick_ms = self.traffic.source, self.clock.sim_dt_s * 1000.0
        self.need(
            "clock.sim_dt_s",
            abs(tick_ms - round(tick_ms)) < 1e-9,
            f"must be whole milliseconds with traffic.source = {source}: SUMO counts in them",
        )
        check(
            not self.map.programs and not self.map.program,
            "map.programs",
            self.map.programs or self.map.program,
            f"traffic.source = {source}: SUMO has the signals; name such files in its .sumocfg",
        )
        self.need(
            "workers.balance_steps",
            source == "sumo-demand" or self.workers.balance_steps == 0,
            f"traffic.source = {source}: a process that takes up a SUMO has to run it again from "
            "the beginning of the episode; leave it 0",
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
                f"traffic.source = {source}: when SUMO's signals change is not known; set it false",
            )
        self.need(
            "population.types",
            set(self.population.types) == {"car"},
            f"traffic.source = {source}: SUMO knows our car alone; leave it out",
        )
        self.need(
            "population.insertions",
            self.population.insertions == 0,
            f"traffic.source = {source}: SUMO knows only vehicles of its demand; leave it out",
        )
        self.need(
            "scenario.name",
            not self.scenario.name,
            f"traffic.source = {source}: scenes are for native traffic; leave one out",
        )

    @property
    def registered(self) -> tuple[str, ...]:
        """What it may name from outside of the package."""
        return (*self.terms.registered, *self.sensors.registered, self.traffic.model)

    @property
    def max_steps(self) -> int:
        """Steps until truncation, of a configuration whose horizon is known."""
        return max(1, round(self.horizon_s / self.clock.ctrl_dt_s))
