"""The worlds of a node: numbered commands, executed in one thread at a time."""

from __future__ import annotations

import itertools
import secrets
import threading
from collections.abc import Callable
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from pydantic import ValidationError

from cavmarl.client.world_protocol import flatten, pack
from cavmarl.core.errors import CapacityError, ConfigError, MissingExtraError
from cavmarl.env.vector import CavVectorEnv, make_vec
from cavmarl.parallel.nodes.node_groups import NodeGroups
from cavmarl.parallel.nodes.node_worlds import NodeWorlds
from cavmarl.parallel.worlds.local_worlds import LocalWorlds, kept_elsewhere, missing_in_states
from cavmarl.service.change_bodies import (
    BeginRecording,
    Change,
    CloseRoad,
    DamageRoad,
    DeclareEvent,
    InsertVehicle,
    KeptSession,
    OpenRoad,
    SetScenario,
)
from cavmarl.service.configurations import world_of
from cavmarl.service.error_names import problem
from cavmarl.service.session_recording import SessionRecording
from cavmarl.traffic.scenarios.library import scenario_names
from cavmarl.viewer.live_env import ShownEnv
from cavmarl.viewer.web_options import WebOptions

SAVED_EVERY = 50  # number of commands between two saved states
TOLD_OF_TRANSFERS = ("episode", "tick", "vehicle", "source", "target", "epoch")
_SIZE_BYTES = 4  # size of the length field at the end of a saved state


class SessionWorld:
    """The worlds of one session.

    Args:
        document: configuration of the worlds.
        keys: further keywords of `make_vec`; its overrides are added to the document's.
        state: state that another node saved, or None for new worlds.
        number: number of commands that the state includes.
        files: folder with the files of the configuration, which `close` deletes; None: it has none.

    Attributes:
        number: number of commands so far.
        saved: number of commands that the state stored with the service includes.
        is_changed: whether a page (the viewer in a browser) has changed the worlds since `saved`.
        is_commanded: whether a command is running, so that pages have to wait.
        recording: the recording of the worlds; None: they are not recorded.
    """

    def __init__(
        self,
        document: dict[str, Any],
        state: bytes | None,
        number: int,
        keys: dict[str, Any],
        files: TemporaryDirectory[str] | None = None,
    ) -> None:
        self._files = files
        self.number = self.saved = number
        self.recording: SessionRecording | None = None
        self._document, self._keys = document, keys
        self._scenario: SetScenario | None = None  # None: the scenario of the configuration
        self._take(self._made(None))
        self._last = b""  # the answer to the last command
        self.is_changed = self.is_commanded = False
        self._page: ShownEnv | None = None  # the pages of the worlds
        self._tokens = secrets.token_urlsafe(24), secrets.token_urlsafe(24)
        # (W,) worlds that a page has restarted since the last command
        self._anew = np.zeros(document["num_envs"], dtype=np.bool_)
        if state:
            try:
                self._load(state)
            except BaseException:
                self.close()
                raise

    def _made(self, scenario: SetScenario | None) -> CavVectorEnv:
        """Return new worlds of the configuration, with a scenario of a command."""
        document, more = self._document, dict(self._keys)
        environment, world = world_of(document, self._folder)
        overrides = {**world["overrides"], **more.pop("overrides", {})}
        if scenario is not None:
            chosen = scenario.model_dump(exclude={"kind"})
            overrides = {
                key: value for key, value in overrides.items() if not key.startswith("scenario.")
            }
            overrides["scenario"] = chosen
        shape = {"num_envs": document["num_envs"], "seed": document["seed"]}
        return make_vec(environment, **(world | more | shape | {"overrides": overrides}))

    def _take(self, vec: CavVectorEnv) -> None:
        """Step these worlds from now on."""
        self._vec = vec
        # Zones run in this process or on nodes, never in workers.
        self._worlds: LocalWorlds | NodeWorlds | NodeGroups = vec.worlds  # type: ignore[assignment]
        # number of transfers of each world reported to the service
        self._told = [0] * len(self._worlds.transfers)

    @property
    def _folder(self) -> str:
        return "" if self._files is None else self._files.name

    def has_files(self, files: TemporaryDirectory[str]) -> bool:
        """Return whether the worlds were made with this folder."""
        return self._files is files

    def describe(self) -> dict[str, Any]:
        """Return shapes and names that a client needs."""
        vec = self._vec
        actions: Any = vec.action_space
        seen: Any = vec.observation_space
        shape = getattr(seen, "shape", None)
        return {
            "number": self.number,
            "saved": self.saved,
            "agents": vec.possible_agents,
            "num_envs": vec.num_envs,
            "max_cycles": vec.max_cycles,
            "step_s": vec.step_s,
            "action": {"shape": list(actions.shape), "dtype": _little(actions.dtype)},
            "observation": {"shape": list(shape or ()), "dtype": _little(seen.dtype or "f4")},
        }

    def _load(self, state: bytes) -> None:
        size = int.from_bytes(state[-_SIZE_BYTES:], "little")
        end = len(state) - _SIZE_BYTES - size
        try:
            kept = KeptSession.model_validate_json(state[max(end, 0) : end + size])
        except ValidationError as error:
            raise problem("damaged", "the end of the saved state is not valid") from error
        if end < 0 or len(kept.begun_anew) != len(self._anew):
            raise problem("damaged", "the saved state is for another number of worlds")
        try:
            if kept.scenario is not None:
                self._begin_scenario(kept.scenario)
            self._vec.load_state(state[:end])
        except ConfigError as error:
            raise problem("damaged", f"the saved state cannot be used: {error}") from error
        self._anew[:] = kept.begun_anew
        if kept.recording is not None:
            include, part = kept.recording.include, kept.recording.part
            self.recording = SessionRecording(self._vec, include, part, self._folder)

    def state(self) -> bytes | None:
        """Return the saved state, and end the present part of the recording.

        Return None if part of the state is in SUMO or in a journal, or before the first reset.
        """
        if not self._vec.is_ready:
            return None
        try:
            found = self._vec.save_state()
        except ConfigError:
            return None
        if self.recording is not None:
            self.recording.end_part(self._vec)
            self.recording.begin(self._vec)
        kept = KeptSession(
            begun_anew=self._anew.tolist(),
            scenario=self._scenario,
            recording=None if self.recording is None else self.recording.kept,
        )
        end = kept.model_dump_json().encode()
        self.is_changed = False
        return found + end + len(end).to_bytes(_SIZE_BYTES, "little")

    def state_of_worlds(self) -> bytes:
        """Return the state of the worlds alone, as `CavVectorEnv.save_state` does."""
        return self._vec.save_state()

    def drop_recording(self) -> None:
        """End the recording without the parts that the service does not have."""
        if self.recording is not None:
            self.recording.close(self._vec)
            self.recording = None

    def command(self, number: int, act: Callable[[], bytes], is_quiet: bool) -> bytes:
        """Execute a command and return its answer; a repeated command gets the same answer.

        Args:
            number: number of the command.
            act: executes the command: `reset`, `step` or `change` with their arguments.
            is_quiet: whether to return nothing.
        """
        if number == self.number and number and self._last:
            return self._last
        if number != self.number + 1:
            raise problem(
                "conflict", f"command {number} after {self.number}: numbers must increase by one"
            )
        answer = act()
        self.number, self._last = number, answer
        if self._page is not None:
            self._heed_pages(self._page)
        return b"" if is_quiet else answer

    def reset(self, seed: int | None) -> bytes:
        """Start an episode in every world."""
        observations, infos = self._vec.reset(seed=seed)
        self._anew[:] = False
        self._move_page()
        return pack(flatten("observations", observations) | _flat(infos))

    def step(self, content: bytes) -> bytes:
        """Step all worlds with actions as bytes."""
        form: Any = self._vec.action_space
        dtype = np.dtype(_little(form.dtype))
        wanted = dtype.itemsize * int(np.prod(form.shape))
        if len(content) != wanted:
            raise problem(
                "bad-body",
                f"actions are {len(content)} bytes: must be {wanted}, {form.shape} of {dtype.str}",
            )
        actions = np.frombuffer(content, dtype).reshape(form.shape)
        observations, rewards, ended, cut, infos = self._vec.step(actions)
        told = {"rewards": rewards, "terminations": ended, "truncations": cut}
        if self._anew.any():
            infos["begun_anew"] = self._anew.copy()
            self._anew[:] = False
        self._move_page()
        return pack(flatten("observations", observations) | told | _flat(infos))

    def _move_page(self) -> None:
        if self._page is not None:
            self._page.moved()

    def change(self, change: Change) -> bytes:
        """Change the worlds between two steps; a change that is refused changes nothing."""
        vec = self._vec
        match change:
            case InsertVehicle():
                vec.insert_vehicle(change.lane, change.position_m, change.world)
            case CloseRoad():
                vec.close_road(change.edge, change.lanes, change.world, change.shuts_in)
            case OpenRoad():
                vec.open_road(change.edge, change.lanes, change.world)
            case DamageRoad():
                vec.damage_road(change.edge, change.speed_mps, change.lanes, change.world)
            case DeclareEvent():
                vec.declare_event(change.world, change.agent, change.cause)
            case SetScenario():
                self._begin_scenario(change)
            case BeginRecording():
                self._begin_recording(change)
        return pack({})

    def _begin_scenario(self, scenario: SetScenario) -> None:
        if self._keys:
            raise problem(
                "refused",
                "scenario: worlds with zones on several nodes keep their scenario; give "
                "scenario.name in overrides when you open the session",
            )
        if scenario.name and scenario.name not in scenario_names():
            known = ", ".join(scenario_names())
            raise problem("refused", f"no scenario '{scenario.name}': choose one of {known}")
        vec = self._made(scenario)
        if self.recording is not None:
            self.recording.end_part(self._vec)
        if self._page is not None:
            self._page.close()  # the page shows the earlier worlds
            self._page = None
        self._vec.close()
        self._scenario = scenario
        self._take(vec)
        if self.recording is not None:
            self.recording.begin(vec)

    def _begin_recording(self, change: BeginRecording) -> None:
        if self.recording is not None:
            raise problem("conflict", "the session is being recorded already")
        if key := missing_in_states(self._vec.config):
            raise problem(
                "refused",
                f"{key}: the state of these worlds cannot be saved, so another node could not "
                "continue their recording; record them in your own process",
            )
        self.recording = SessionRecording(self._vec, change.include, files=self._folder)

    def frames(self, is_final: bool) -> bytes:
        """Return the samples of the mounted sensors, as `SENSOR/FIELD`."""
        found = self._vec.final_frames() if is_final else self._vec.frames()
        return pack(
            {
                f"{name}/{field}": array
                for name, sensor in found.items()
                for field, array in sensor._asdict().items()
            }
        )

    def suggestion(self) -> bytes:
        """Return the built-in driver's actions."""
        return pack({"actions": self._vec.suggest_actions()})

    def hashes(self) -> list[str]:
        """Return the state hash of each world."""
        return [self._vec.state_hash(world) for world in range(self._vec.num_envs)]

    def page(self) -> dict[str, str]:
        """Open a page; return its address and the tokens to control and to watch.

        Changes by pages must be part of the saved state, so worlds that cannot be saved can only be
        watched.
        """
        token, watch_token = self._tokens
        if self._page is None:
            control = not kept_elsewhere(self._vec.config)
            options = WebOptions(port=0, token=token, watch_token=watch_token, control=control)
            forms: dict[str, Any] = {"title": "a client of the service", "looks_itself": False}
            try:
                reset = self._begin_anew if control else None
                self._page = ShownEnv(self._vec, options, reset=reset, **forms)
                if self._vec.is_ready:
                    self._page.refresh()
            except (ConfigError, MissingExtraError) as error:
                raise problem("refused", str(error)) from error
        return {"address": self._page.address, "token": token, "watch_token": watch_token}

    @property
    def is_watched(self) -> bool:
        """Return whether a page of the worlds is open."""
        return self._page is not None and self._page.is_watched

    def tell_scores(self, rows: list[dict[str, Any]]) -> None:
        """Show these LoadScores on the pages, below the LoadScores of the worlds' own nodes."""
        if self._page is not None:
            self._page.tell_others(rows)

    def tend(self) -> float:
        """Serve the pages between commands; return how long the next command must wait, in s."""
        if self._page is None or self.is_commanded:
            return 0.0
        return self._heed_pages(self._page)

    def _heed_pages(self, page: ShownEnv) -> float:
        before = page.changes
        wait_s = page.turn()
        self.is_changed |= page.changes > before
        return wait_s

    def _begin_anew(self, world: int) -> None:
        """Restart the episode of one world for a page; the next answer reports it."""
        chosen = np.arange(len(self._anew)) == world
        self._vec.reset(options={"reset_mask": chosen})
        self._anew |= chosen

    def transfers(self) -> list[dict[str, Any]]:
        """Return the most recent ownership transfers of divided worlds."""
        found = self._worlds.transfers
        return [
            {"world": world, **row._asdict()} for world, log in enumerate(found) for row in log.rows
        ]

    def ownership(self) -> dict[str, list[list[int]]]:
        """Return the transfers since the last call and the prepared ones, see `TransfersBody`."""
        rows, prepared = [], []
        for world, log in enumerate(self._worlds.transfers):
            known, number = self._told[world], self._num_transfers(world)
            self._told[world] = number
            for row in itertools.islice(log.rows, max(len(log.rows) - (number - known), 0), None):
                rows.append([world, *(getattr(row, name) for name in TOLD_OF_TRANSFERS)])
            prepared += [
                [world, one.vehicle, one.source, one.target]
                for one in self._worlds.in_flight(world)
                if one.state.casefold() == "prepared"
            ]
        return {"transfers": rows, "prepared": prepared}

    @property
    def num_transfers(self) -> int:
        """Return the number of transfers."""
        return sum(self._num_transfers(world) for world in range(len(self._told)))

    @property
    def is_divided(self) -> bool:
        """Return whether the worlds have several zones."""
        return bool(self._told)

    @property
    def num_ticks(self) -> int:
        """Return the number of ticks that one step of all worlds takes."""
        return self._vec.num_envs * self._vec.config.clock.ticks_per_step

    def _num_transfers(self, world: int) -> int:
        counts = self._worlds.transfers[world].counts
        return counts["switched"] + counts["forced"]

    def close(self) -> None:
        """Release memory and processes."""
        if self._page is not None:
            self._page.close()
            self._page = None
        self.drop_recording()
        self._vec.close()
        if self._files is not None:
            self._files.cleanup()


class SessionWorlds:
    """The sessions of a node. Commands run one at a time, as kernels use a whole core.

    Args:
        slots: maximum number of sessions.
    """

    def __init__(self, slots: int) -> None:
        self.lock = threading.Lock()
        self.ticks = self.steps = self._past_transfers = 0
        self.wait_s = 0.0
        self._slots = slots
        self._worlds: dict[str, SessionWorld] = {}

    def __contains__(self, session: str) -> bool:
        return session in self._worlds

    def __getitem__(self, session: str) -> SessionWorld:
        if session not in self._worlds:
            raise problem("lost", f"session '{session}' is not on this node: resolve it again")
        return self._worlds[session]

    def add(
        self,
        session: str,
        document: dict[str, Any],
        state: bytes | None,
        number: int,
        keys: dict[str, Any],
        files: TemporaryDirectory[str] | None = None,
    ) -> None:
        """Create the worlds of a session; for the arguments, see `SessionWorld`."""
        if len(self._worlds) >= self._slots:
            raise CapacityError(
                f"this node has {self._slots} sessions already: resolve the session again later"
            )
        with self.lock:
            if session not in self._worlds:
                self._worlds[session] = SessionWorld(document, state, number, keys, files)

    def count_step(self, session: str) -> None:
        """Count a step of a session."""
        self.steps += 1
        self.ticks += self[session].num_ticks

    def counters(self) -> dict[str, float]:
        """Return the counters of a heartbeat."""
        present = sum(world.num_transfers for world in list(self._worlds.values()))
        return {
            "ticks": float(self.ticks),
            "steps": float(self.steps),
            "wait_s": self.wait_s,
            "transfers": float(self._past_transfers + present),
        }

    @property
    def is_watched(self) -> bool:
        """Return whether a page of any session is open."""
        return any(world.is_watched for world in list(self._worlds.values()))

    def tell_scores(self, scores: list[dict[str, Any]]) -> None:
        """Show the LoadScores of the service's nodes on pages.

        Without scores, keep the previous ones.
        """
        if not scores:
            return
        rows = [
            {
                "name": f"{one['name']}, node of the service",
                "zones": f"{one['sessions']} sessions",
                "score": one["score"],
                "note": "no load reported" if one["state"] == "up" else one["state"],
            }
            for one in scores
        ]
        for world in list(self._worlds.values()):
            world.tell_scores(rows)

    def divided(self) -> list[str]:
        """Return the sessions whose worlds have zones."""
        return [session for session, world in list(self._worlds.items()) if world.is_divided]

    def keep_only(self, sessions: set[str]) -> None:
        """Close all sessions except these: they have ended, or other nodes host them now."""
        for session in [one for one in self._worlds if one not in sessions]:
            self.close(session)

    def close(self, session: str) -> None:
        """Close the worlds of a session."""
        with self.lock:
            world = self._worlds.pop(session, None)
            if world is not None:
                self._past_transfers += world.num_transfers
                world.close()


def _little(dtype: Any) -> str:
    return str(np.dtype(dtype).newbyteorder("<").str)


def _flat(infos: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in infos.items():
        found |= flatten(f"infos/{name}", value)
    return found
