"""`FollowedWorld`: a world whose time a master advances and whose agents followers drive.

The cycle is Algorithm 1 of the co-simulation paper (docs/explanation/papers.md): the queued
controls take effect, the world ticks, sensors deliver the frame of t + Δt, each follower computes
controls u from it, and u is queued for the next cycle. The cycle ends when every follower has
answered. So a slow follower delays the world, and no frame is skipped.

Followers are served in the order of their first agent; followers without agents come last, sorted
by name. Answers may arrive in any order without effect on the result.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal, Self

from cavmarl.core.errors import (
    CavmarlError,
    ConfigError,
    EpisodeError,
    FollowerError,
    FollowerLostError,
)
from cavmarl.cosim.actors.client_actors import ActorOrder, ClientActor, ClientActors
from cavmarl.cosim.actors.pose_traces import PoseTrace, TracePlayer
from cavmarl.cosim.followers.follower_barrier import (
    BadControls,
    Barrier,
    BarrierOutcome,
    FollowerSeat,
)
from cavmarl.cosim.followers.follower_connection import (
    Address,
    FollowerConnection,
    Reception,
    refuse,
)
from cavmarl.cosim.followers.follower_messages import ActorRequest, Hello, Say
from cavmarl.cosim.followers.follower_snapshots import SnapshotTime, welcome_to
from cavmarl.cosim.time_master import OwnTicks, Pacer, TimeMaster
from cavmarl.engine.step_trace import QUEUE, STACK, StepTrace
from cavmarl.env.parallel import CavEnv


class FollowedWorld:
    """A master, its world, and a socket for followers.

    The built-in driver drives all agents without a follower, including those whose follower has
    left.

    Args:
        env: the world, in this process or in workers; it has a time master until `close`.
        address: path of a Unix socket, or a port of this machine; 0 picks a free port.
        secret: secret of followers; necessary for a port, to which all users can connect.
        timeout_s: maximum time that a step waits for its followers, by the wall clock.
        own_ticks: handling of a follower's own ticks; see `TimeMaster`.
        on_drift: see `TimeMaster`.
        bad_controls: handling of invalid controls: `error`: the follower is dropped with a
            `FollowerError`; `hold`: the vehicle's last controls are used, and counted.
        pacer: pace by the wall clock; None: as fast as possible.
        trace: records the phases of each step.
        truth: whether followers may receive the true state of all vehicles.
        traces: recorded poses of bodies that the world plays in each episode.

    Attributes:
        master: the time master.
        address: path or port to which followers connect.
        actors: the actors that followers and traces have brought into the world.
        player: plays the traces.

    Raises:
        ConfigError: the address cannot be opened, a port has no secret, signals have agents, or a
            trace is given for a world that workers run.
        ClockError: the environment already has a master.
    """

    def __init__(
        self,
        env: CavEnv,
        address: Address,
        *,
        secret: str = "",
        timeout_s: float = 10.0,
        own_ticks: OwnTicks = "refuse",
        on_drift: Literal["error", "record"] = "error",
        bad_controls: BadControls = "error",
        pacer: Pacer | None = None,
        trace: StepTrace | None = None,
        truth: bool = False,
        traces: Sequence[PoseTrace] = (),
    ) -> None:
        if not 0.0 < timeout_s < float("inf"):
            raise ConfigError(f"timeout_s = {timeout_s}: must be a number above 0")
        if refusal := env.config.refusal_of_agents("a followed world"):
            raise ConfigError(refusal)
        self.env = env
        self._reception = Reception(address, secret)
        self.address = self._reception.address
        try:
            self.master = TimeMaster(
                env, pacer=pacer, own_ticks=own_ticks, on_drift=on_drift, trace=trace
            )
        except BaseException:
            self.close_reception()
            raise
        self._timeout_s, self._truth = timeout_s, truth
        self.actors = ClientActors(env)
        self.player = TracePlayer(self.actors, traces, env.step_s)
        self._barrier = Barrier(env, self.actors, timeout_s, bad_controls)
        self._trace = trace
        self._seats: list[FollowerSeat] = []
        self._queued: dict[str, Any] = {}
        self._frame = self._episode = -1
        self._moment = SnapshotTime(-1, -1, int(self.master.world_ticks[0]), False)
        self._is_closed = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def seats(self) -> tuple[FollowerSeat, ...]:
        return tuple(self._seats)

    @property
    def leader(self) -> FollowerSeat | None:
        """The follower whose ticks release the steps of the world; None: there is none."""
        return next((seat for seat in self._seats if seat.leads), None)

    @property
    def is_over(self) -> bool:
        return not self.env.agents

    def wait_for(self, followers: int, within_s: float) -> None:
        """Wait until this many followers have joined.

        Raises FollowerLostError: too few have joined in time.
        """
        until_s = time.monotonic() + within_s
        while len(self._seats) < followers:
            left_s = until_s - time.monotonic()
            if left_s <= 0.0:
                raise FollowerLostError(
                    f"{len(self._seats)} of {followers} followers have called {self.address} "
                    f"within {within_s:g} s; start them with `cavmarl follow "
                    f"ENV --at {self.address}`",
                    is_late=True,
                )
            self.admit(left_s)

    def reset(self, seed: int | None = None) -> None:
        """Start an episode and send its first snapshot to the followers.

        Raises FollowerError: see `step`.
        """
        self.admit(0.0)
        self.player.begin_episode()
        self.master.reset(seed)
        self._episode += 1
        self._queued.clear()
        self._refuse(self.actors.begin_episode())
        self._next_frame()
        self._exchange(self._seats)

    def step(self) -> dict[str, float]:
        """Run one cycle and return the rewards by agent.

        Raises:
            EpisodeError: the episode is over.
            FollowerLostError: a follower has not answered in time, or has ended; it is dropped. The
                world has advanced by one step, and the next call continues from there.
            FollowerError: a follower's messages are invalid, or its controls cannot be carried out;
                the consequences are as for a FollowerLostError.
            ActionError, CapacityError, ConfigError: the world refuses a body of a trace.
            ClockError: another caller has advanced the world.
        """
        if self.is_over:
            raise EpisodeError("the episode is over; call FollowedWorld.reset()")
        self.admit(0.0)
        self._exchange([seat for seat in self._seats if seat.frame < self._frame])
        self._hear_others()
        self._await_leader()
        now_s = self._moment.tick * self.env.config.clock.sim_dt_s
        self.player.act(now_s)
        self._refuse(self.actors.act(now_s))
        agents = self.env.agents
        actions = {agent: self._queued[agent] for agent in agents if agent in self._queued}
        if len(actions) < len(agents):
            actions = {**self.env.suggest_actions(), **actions}
        _, rewards, *_ = self.master.step(actions)
        self._queued.clear()
        self._next_frame()
        self._confirm_tick()
        self._exchange(self._seats)
        return dict(rewards)

    def manifest(self) -> dict[str, Any]:
        """Return the conditions of a result: the followers, and when controls take effect."""
        clock = self.env.config.clock
        return {
            "sim_dt_s": clock.sim_dt_s,
            "ctrl_dt_s": clock.ctrl_dt_s,
            "control_latency_steps": 1,  # queued for the next cycle, as in Algorithm 1
            "control_latency_ticks": clock.control_latency_ticks,
            "followers": [
                {
                    "name": seat.clock.name,
                    "agents": self._names(seat.agents),
                    "actors": [asdict(actor.order) for actor in seat.actors],
                    "waits": seat.waits,
                    "leads": seat.leads,
                }
                for seat in self._seats
            ],
        }

    def close(self) -> None:
        """Send goodbye to all followers and release the environment; repeated calls do nothing."""
        if self._is_closed:
            return
        self._is_closed = True
        for seat in list(self._seats):
            with suppress(FollowerError):
                seat.line.say(Say.GOODBYE, within_s=self._timeout_s)
            self._drop(seat)
        self.close_reception()
        self.master.release()

    def close_reception(self) -> None:
        self._reception.close()
        if not isinstance(self.address, int):
            Path(self.address).unlink(missing_ok=True)

    def admit(self, within_s: float) -> None:
        """Add followers that have sent HELLO; wait up to `within_s` for the first one."""
        for line, hello in self._reception.callers(within_s):
            try:
                self._seat(line, hello)
            except FollowerError as error:
                refuse(line, str(error))

    def _seat(self, line: FollowerConnection, hello: Hello) -> None:
        agents = self._indices(hello.vehicles)
        if hello.truth and not self._truth:
            raise FollowerError(
                f"'{hello.name[:80]}' requests the true state of all vehicles, which this world "
                "does not give; start it with truth=True (cavmarl lead --truth)"
            )
        if agents and not hello.waits:
            raise FollowerError(
                f"'{hello.name[:80]}' drives agents, so the world has to wait for its answers; "
                "leave waits = True"
            )
        if hello.leads and self.leader is not None:
            raise FollowerError(
                f"'{hello.name[:80]}' asks to lead, but '{self.leader.clock.name}' leads already; "
                "a world has one time master"
            )
        welcome = welcome_to(self.env, self._names(agents), self.master.tick)
        try:
            actors = self.actors.join(hello.name, map(order_of, hello.actors))
        except CavmarlError as error:
            raise FollowerError(f"'{hello.name[:80]}': {error}") from error
        try:
            line.say(Say.WELCOME, welcome, within_s=self._timeout_s)
        except FollowerError:
            self.actors.part(actors)
            raise
        clock = self.master.follow(hello.name)
        seat = FollowerSeat(
            line, clock, agents, hello.truth, tuple(actors), hello.waits, hello.leads
        )
        self._seats.append(seat)
        self._seats.sort(key=lambda each: each.rank)

    def _indices(self, vehicles: Sequence[str]) -> tuple[int, ...]:
        """Return the indices of the agents that a new follower requests.

        Raises FollowerError: an agent does not exist, or another follower drives it.
        """
        ids = self.env.possible_agents[: self.env.config.population.num_ids]
        known = {agent: k for k, agent in enumerate(ids)}
        taken = {k: seat.clock.name for seat in self._seats for k in seat.agents}
        for agent in vehicles:
            if agent not in known:
                raise FollowerError(
                    f"no agent '{agent[:80]}'; choose among {ids[0]} to {ids[-1]}"
                    if ids
                    else f"no agent '{agent[:80]}': this world has none; bring an actor"
                )
            if known[agent] in taken:
                raise FollowerError(
                    f"{agent} is driven by '{taken[known[agent]]}'; request another agent"
                )
        if len(set(vehicles)) < len(vehicles):
            raise FollowerError("an agent is requested twice; name each once")
        return tuple(sorted(known[agent] for agent in vehicles))

    def _names(self, agents: Iterable[int]) -> list[str]:
        return [self.env.possible_agents[k] for k in agents]

    def _drop(self, seat: FollowerSeat) -> None:
        seat.line.close()
        self._seats.remove(seat)
        self.actors.part(seat.actors)
        if seat.clock in self.master.followers:
            seat.clock.leave()

    def _next_frame(self) -> None:
        self._frame += 1
        tick = int(self.master.world_ticks[0])
        self._moment = SnapshotTime(self._frame, self._episode, tick, self.is_over)

    def _exchange(self, seats: Sequence[FollowerSeat]) -> None:
        """Send snapshots of the world and queue the followers' controls.

        Raises FollowerError: the error of the first follower, in their order, with which the world
        cannot continue; the controls of the other followers are queued anyway.
        """
        if self._episode < 0 or not seats:
            return
        self._note(STACK)
        found = self._barrier.pass_through(list(seats), self._moment)
        self._note(QUEUE)
        self._queued |= found.actions
        self._settle(found)

    def _hear_others(self) -> None:
        """Receive messages of the followers for which the world does not wait.

        Raises FollowerError: the messages of a follower are invalid.
        """
        others = [seat for seat in self._seats if not seat.waits]
        if others:
            self._settle(self._barrier.hear_others(others, self._moment))

    def _await_leader(self) -> None:
        """Wait for the tick of the follower that leads.

        Raises FollowerError: the follower does not tick in time, or sends invalid messages.
        """
        if (leader := self.leader) is not None:
            self._settle(self._barrier.await_tick(leader, self._moment))

    def _confirm_tick(self) -> None:
        """Tell the follower that leads that its step has been made.

        Raises FollowerLostError: the follower has ended.
        """
        if (leader := self.leader) is not None:
            try:
                self._barrier.confirm_tick(leader)
            except FollowerLostError as error:
                self._settle(BarrierOutcome(failed={leader: error}))

    def _settle(self, found: BarrierOutcome) -> None:
        """Drop the followers that have left or failed.

        Raises FollowerError: the error of the first failed follower, in their order.
        """
        for seat in found.left:
            self._drop(seat)
        failed = sorted(found.failed, key=lambda seat: seat.rank)
        for seat in failed:
            refuse(seat.line, str(found.failed[seat]))
            self._drop(seat)
        if failed:
            raise found.failed[failed[0]]

    def _refuse(self, refused: Mapping[ClientActor, CavmarlError]) -> None:
        """Drop the followers of refused actors, and tell them the reasons.

        Raises CavmarlError: an actor of a trace is refused.
        """
        owners = {actor: seat for seat in self._seats for actor in seat.actors}
        for actor, error in refused.items():
            if actor not in owners:
                raise error
            if owners[actor] in self._seats:
                refuse(owners[actor].line, f"actor '{actor.name}': {error}")
                self._drop(owners[actor])

    def _note(self, phase: str) -> None:
        if self._trace is not None:
            self._trace.note(phase)
        if self.master.watch is not None:
            self.master.watch.note(phase)


def order_of(request: ActorRequest) -> ActorOrder:
    """Return a requested actor. Raises FollowerError: the size does not have three numbers."""
    size = request.size_m
    if size and len(size) != 3:
        raise FollowerError(
            f"actor '{request.name[:80]}': size_m has {len(size)} numbers: must be length, width "
            "and height, or empty"
        )
    return ActorOrder(
        name=request.name,
        vtype=request.type,
        x=request.x,
        y=request.y,
        heading=request.heading,
        z=request.z,
        size_m=(size[0], size[1], size[2]) if size else None,
        speed=request.speed,
        moved_by=request.moved_by,
        rate_hz=request.rate_hz,
        extrapolation_s=request.extrapolation_s,
        rig=tuple(request.rig),
    )
