"""What a world is: `EnvConfig`, frozen dataclasses whose fields are the keys of `env.yaml`.

A unit ends the name of every bare number. Each class refuses, in `__post_init__`, the values and
the combinations that cannot work, and says what to change. Types and unknown keys are checked at
the border by `registry.load_config`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from cavmarl.config.action import ActionConfig as ActionConfig
from cavmarl.config.checks import Section, Whole, Within
from cavmarl.config.checks import check as _check
from cavmarl.config.checks import check_finite as _check_finite
from cavmarl.config.rig import Rig, check_rig
from cavmarl.config.scenario import ScenarioConfig
from cavmarl.config.sensors import SensorsConfig as SensorsConfig
from cavmarl.config.sumo import SumoConfig
from cavmarl.config.v2x import V2xConfig
from cavmarl.core.extensions import REGISTERED_TERMS

# The named terms of one step, in the order of every terms array (`rewards/kernels/terms.py`).
TERMS = (
    "progress",
    "speeding",
    "jerk",
    "ttc_risk",
    "collision",
    "off_road",
    "wrong_way",
    "red_light",
    "arrival",
    "delay",
)

BY_MAP = 0.0  # a horizon in s that the map says
MAX_ZONES = 256  # of one map
ZONE_LAYOUTS = ("grid", "strips", "bisection")
ZONE_FILE_SUFFIXES = (".json", ".yaml", ".yml")

MAX_SENSOR_WORKERS = 256  # of one process
MAX_IDS = 1_000_000  # of agents in one episode: each has its space and its rows in every output


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
class ZonesConfig(Section, key="zones"):
    """How the map is divided; see docs/zones.md.

    Attributes:
        layout: how zones are cut: `grid`, `strips`, `bisection`, or a zone file named as
            `map.source` is.
        count: number of zones; of a zone file, as many as it has.
        avoid_junctions: move cuts aside where that keeps junctions whole.
        weight: what `bisection` shares out evenly: length of lanes, or area.
        hysteresis_m: how far behind a border a vehicle changes its zone.
        max_deferred_ticks: ticks for which a vehicle that has crossed stays with its old zone, if
            the new one does not acknowledge it.
        policy: what follows: `force`: the change is forced at once; `extend`: after `grace_ticks`
            more. With `hold` a vehicle is stopped before the border if the zone behind it has not
            acknowledged it for more than `grace_ticks`; with `reroute` it takes a way around that
            zone, if there is one. A world in which that happens is not the undivided one any more.
        grace_ticks: that `extend` grants behind a border, `hold` and `reroute` before it.
        backoff_ticks: for which a zone that has refused a vehicle is not asked again.
        halo_m: how far zones see over their borders; default: as far as exactness needs, and less
            is refused.
        approach_ticks: so many ticks before a vehicle is there at its present speed, the zone that
            it drives to is told.
        journal: file for the coordinator's log; empty: none. It must not exist.
        check_invariants: watch the invariants of ownership at run time.
        faults: a plan of faults to inject, as JSON or a file of it; empty: none.
        reproducers: folder for ticks that every host of a zone died of, from which they can be run
            again. With it, what a zone's code raises is the death of its host. Empty: only where
            faults kill hosts, and then the system's folder for temporary files.
        repartition_steps: every so many steps zones become others by bisection of where the
            vehicles are,
            if that shares them out better; results do not depend on it. 0: they stay.
        repartition_tolerance: by which share of the mean the fullest zone has to become emptier.
    """

    layout: str = "bisection"
    count: Annotated[int, Whole(1, MAX_ZONES)] = 1
    avoid_junctions: bool = False
    weight: Literal["lane_length", "uniform"] = "lane_length"
    hysteresis_m: Annotated[float, Within(0.0, 100.0)] = 2.0
    max_deferred_ticks: Annotated[int, Whole(0, 1000)] = 2
    policy: Literal["force", "extend", "hold", "reroute"] = "force"
    grace_ticks: Annotated[int, Whole(0, 1000)] = 0
    backoff_ticks: Annotated[int, Whole(0, 1000)] = 4
    halo_m: Annotated[float | None, Within(0.0, 1e6)] = None
    approach_ticks: Annotated[int, Whole(1, 1000)] = 2
    journal: str = ""
    check_invariants: bool = False
    faults: str = ""
    reproducers: str = ""
    repartition_steps: Annotated[int, Whole(0, 1_000_000)] = 0
    repartition_tolerance: Annotated[float, Within(0.0, 100.0)] = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        self.need(
            "layout",
            self.layout in ZONE_LAYOUTS or self.layout.endswith(ZONE_FILE_SUFFIXES),
            f"must be {', '.join(ZONE_LAYOUTS)}, or a zone file ({', '.join(ZONE_FILE_SUFFIXES)})",
        )
        self.need(
            "grace_ticks",
            (self.policy == "force") == (self.grace_ticks == 0),
            "must be 1 or more with extend, hold and reroute of zones.policy, and 0 with force",
        )
        self.need(
            "repartition_steps",
            not (self.repartition_steps and (self.faults or self.reproducers)),
            "vehicles that change their zone must not be late: leave out zones.faults and "
            "zones.reproducers, or let zones stay",
        )

    @property
    def holds(self) -> bool:
        """Whether vehicles are kept from borders whose other side does not answer.

        A divided world in which that happens is not the undivided one.
        """
        return self.policy in ("hold", "reroute")


@dataclass(frozen=True)
class WorkersConfig(Section, key="workers"):
    """How worker processes are watched and given work, where there are some; see docs/workers.md.

    Attributes:
        timeout_s: for so long a worker may be busy with one step or reset; then it is taken to hang
            and replaced. One that is stopped or sleeps is noticed within a second.
        max_retries: how often a step is begun again because a worker has died.
        pin: keep each worker on a core of its own. The system sometimes leaves two on one; but of
            several environments with workers on one machine all take the same cores.
        balance_steps: so many steps from one round to the next, in which worlds, or zones of a
            split world, may change their worker by what they have cost; 0: they stay where they
            are. Results do not depend on it.
        imbalance_tolerance: while the slowest worker takes at most this share longer than a
            perfect division
            would, nothing moves.
        max_moves: worlds or zones that change their worker in one round.
        monitor_cpu: see how busy others keep the workers' cores, and give nothing more to
            workers above a threshold; without it the cores are taken to be free.
        sensors: processes that the sensors of `rig` are shared out over, for each process that
            keeps the state of worlds; 0: it senses itself. Results do not depend on it. See
            docs/sensor_workers.md.
        sensor_placement: which of them senses what: by what it `cost` of late, or `in_turn`.
        join_timeout_s: for so long is waited for zone nodes to join; see docs/nodes.md.
        key_file: with the key that nodes started by hand have to know; relative to the environment.
    """

    timeout_s: Annotated[float, Within(1.0, 1e6)] = 300.0
    max_retries: Annotated[int, Whole(0, 1000)] = 3
    pin: bool = False
    balance_steps: Annotated[int, Whole(0, 1_000_000)] = 0
    imbalance_tolerance: Annotated[float, Within(0.0, 100.0)] = 0.1
    max_moves: Annotated[int, Whole(1, 65_536)] = 4
    monitor_cpu: bool = False
    sensors: Annotated[int, Whole(0, MAX_SENSOR_WORKERS)] = 0
    sensor_placement: Literal["cost", "in_turn"] = "cost"
    join_timeout_s: Annotated[float, Within(1.0, 1e6)] = 300.0
    key_file: str = ""


@dataclass(frozen=True)
class PopulationConfig(Section, key="population"):
    """The vehicles of a world.

    Attributes:
        mode: `closed`: all agents enter at reset. `open`: agents also enter during the episode,
            each id once, `budget` in all. `respawn`: `agents` fixed ids; when the vehicle of one
            ends, the id gets a new vehicle.
        agents: vehicles driven by policies at any one time.
        background: vehicles driven by the built-in drivers. In `closed` worlds they are placed at
            reset; else each arrival orders a new departure, so that their number holds.
        budget: how many agents may enter in one episode of an `open` world (default 4 ·
            agents); the other modes do not read it.
        types: vehicles of the agents in turn, of `car`, `truck` and `bus`: agent k has the one
            at place k, counted round.
        insertions: how many vehicles may be put into a world in one episode while it runs
            (`insert_vehicle`, `close_road`); there is room for them.
    """

    mode: Literal["closed", "open", "respawn"] = "closed"
    agents: Annotated[int, Whole(0, 100_000, "; 0: a world to watch")] = 4
    background: Annotated[int, Whole(0, 1_000_000)] = 20
    budget: int | None = None
    types: tuple[Literal["car", "truck", "bus"], ...] = ("car",)
    insertions: Annotated[int, Whole(0, 10_000)] = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.need("types", bool(self.types), "must name at least one of car, truck, bus")
        if self.budget is not None and self.mode == "open":
            self.need(
                "budget",
                self.agents <= self.budget <= MAX_IDS,
                f"must be at least population.agents = {self.agents}, and at most {MAX_IDS}",
            )

    @property
    def num_ids(self) -> int:
        """How many agent ids an episode can use."""
        if self.mode == "open":
            return self.budget if self.budget is not None else 4 * self.agents
        return self.agents


@dataclass(frozen=True)
class TrafficConfig(Section, key="traffic"):
    """Where departures come from.

    Attributes:
        source: what reads the demand files. `native`: cavmarl. `sumo-demand`: SUMO says which
            vehicle departs when and on which route, and what signals show; our drivers drive.
            `sumo-traffic`: SUMO moves its vehicles, too. The generator's drive beside them.
        demand: SUMO files of vehicles, flows, routes and types (`.rou.xml`, `.add.xml`,
            `.sumocfg`): named as `map.source`; their vehicles drive beside the generator's.
        on_bad_route: what to do with vehicles of the demand that cannot drive their route, and with
            stops off it: `error`, or `skip` them (counted).
        goals: how many destination edges the generator uses; lane-level plans are made for each.
        origins: edges that agents start on, by id; empty: all that lead somewhere.
        destinations: edges that agents drive to, by id; empty: the generator's goals.
        min_trip_m: shortest way of an agent between origin and destination.
        max_trip_m: longest way of an agent; 0: no limit.
        endless: agents drive on to another goal before they reach theirs, as the background of a
            `closed` world does: 150 m before it, to one that is farther than that.
        speed_factor_spread: half width of the drivers' uniform spread of desired speed over limit.
        model: how the generator's vehicles follow their leader: `IDM`, `Krauss`, `ACC`, or a model
            that is registered (docs/extending.md). Those of `demand` drive as their type says.
        trip_horizon: so many times what its way takes at the limits, and one cycle of each signal
            on it, an agent's trip may take; then the vehicle leaves, and the trip is truncated.
            0: only the episode's horizon cuts it.
    """

    source: Literal["native", "sumo-demand", "sumo-traffic"] = "native"
    demand: tuple[str, ...] = ()
    on_bad_route: Literal["error", "skip"] = "error"
    goals: Annotated[int, Whole(1, 1024)] = 32
    origins: tuple[str, ...] = ()
    destinations: tuple[str, ...] = ()
    min_trip_m: Annotated[float, Within(0.0, 1e6)] = 100.0
    max_trip_m: Annotated[float, Within(0.0, 1e6)] = 0.0
    endless: bool = False
    speed_factor_spread: Annotated[float, Within(0.0, 0.5)] = 0.1
    model: str = "IDM"
    trip_horizon: Annotated[float, Within(0.0, 1000.0)] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.need(
            "trip_horizon",
            self.trip_horizon == 0.0 or self.trip_horizon >= 1.0,
            "must be 0 (none), or 1 or more: no vehicle is faster than the limits allow",
        )
        self.need(
            "source",
            self.source == "native" or bool(self.demand),
            "needs traffic.demand: a .sumocfg, or files of routes",
        )
        self.need(
            "max_trip_m",
            self.max_trip_m == 0.0 or self.max_trip_m > self.min_trip_m,
            f"must be 0 (no limit) or above traffic.min_trip_m = {self.min_trip_m:g}",
        )


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
class TermsConfig(Section, key="terms"):
    """Reward = Σ weight · term; see `TERMS` and docs/environments.md for what each term is.

    Attributes:
        weights: weight of each named term; terms that are not named weigh 0.
        team_share: share of the reward that is the mean over all live agents: 0 individual, 1 team.
        team_range_m: only agents that are so near count in that mean, as the local coordination of
            CoPO has it (Peng et al. 2021); 0: all do.
    """

    weights: dict[str, float] = field(
        default_factory=lambda: {
            "progress": 0.1,
            "speeding": -1.0,
            "jerk": -0.01,
            "ttc_risk": -0.1,
            "collision": -10.0,
            "off_road": -10.0,
            "wrong_way": -1.0,
            "red_light": -5.0,
            "arrival": 10.0,
        }
    )
    team_share: Annotated[float, Within(0.0, 1.0)] = 0.0
    team_range_m: Annotated[float, Within(0.0, 1e6)] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, weight in self.weights.items():
            known = (*TERMS, *REGISTERED_TERMS.names)
            _check(
                name in known,
                "terms.weights",
                name,
                f"no such term; there are {', '.join(known)}, or add one with "
                "cavmarl.register_term",
            )
            _check_finite(f"terms.weights.{name}", weight, -1e6, 1e6)

    @property
    def registered(self) -> tuple[str, ...]:
        """The weighted terms that are not of the package."""
        return tuple(name for name in self.weights if name not in TERMS)

    @property
    def names(self) -> tuple[str, ...]:
        """All terms of the world, in the order of every terms array."""
        return (*TERMS, *self.registered)

    @property
    def weight_of_each(self) -> tuple[float, ...]:
        """Their weights, in the same order."""
        return tuple(self.weights.get(name, 0.0) for name in self.names)


@dataclass(frozen=True)
class EnvConfig(Section, key=""):
    """The whole decision process of one environment: the keys of `env.yaml`.

    Attributes:
        name: of the entry, as its folder.
        version: goes up whenever results change that others may have reported.
        rig: sensors that are mounted on every agent's vehicle, by name; see docs/sensors.md.
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
        _check_finite("horizon_s", self.horizon_s, self.clock.ctrl_dt_s, 1e6)
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
            _check(
                count == 0 or self.v2x.enabled,
                key,
                count,
                "there are no messages: set v2x.enabled to true, or this to 0",
            )
            _check(count <= most, key, count, f"v2x.inbox.{name} = {most} keeps fewer")
        _check(
            self.v2x.enabled or not self.sensors.messages.signal,
            "sensors.messages.signal",
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
        _check(
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
            _check(
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
