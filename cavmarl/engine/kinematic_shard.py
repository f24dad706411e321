"""`KinematicShard`: cavmarl's own vehicles of one zone, as a `ShardBackend`."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.env import EnvConfig
from cavmarl.core.errors import ConfigError, MessageError
from cavmarl.core.huge_pages import huge_zeros
from cavmarl.core.math.rng import world_key
from cavmarl.core.records.arrays import SharedState
from cavmarl.core.records.codes import ACTION_IDLE
from cavmarl.driving.vehicles import VEHICLE
from cavmarl.engine.shared_outputs import SharedOutputs
from cavmarl.engine.tick_setup import make_frames, make_tick
from cavmarl.roads.network import RoadNetwork
from cavmarl.sensors.observed import carried_from
from cavmarl.shards.shard import Commands, common_of
from cavmarl.shards.shard_backend import VehicleControl
from cavmarl.shards.shard_group import ShardGroup
from cavmarl.zones.partition.zone_partition import ZonePartition


class KinematicShard:
    """One zone of one world. Its caller spawns all vehicles.

    Args:
        config: of the world; vehicles enter by `spawn` only.
        network: the roads of the world.
        partition: all zones of the world.
        zone: the zone of this shard.

    Raises:
        ConfigError: the world uses features for which zones share more than vehicles: messages,
            mounted sensors, scenarios, actuated signals, delayed controls, earlier frames, team
            rewards.
    """

    def __init__(
        self, config: EnvConfig, network: RoadNetwork, partition: ZonePartition, zone: int
    ) -> None:
        shared = SharedOutputs(config, network, 1)
        self._tick = tick = make_tick(
            config, network, partition, None, shared, make_frames(config, 1, huge_zeros),
            huge_zeros, None,
        )  # fmt: skip
        self._shared = shared
        self._refuse_shared_features(config, network)
        self._shard = tick.shards[zone]
        tick.executor = self._executor = ShardGroup([self._shard])
        self.zone = zone
        self.reach_m = tick.division.halo.halo_m
        self._per_step = config.clock.ticks_per_step
        agents = config.population.num_ids
        idle = np.full((1, agents), ACTION_IDLE, dtype=np.int64)
        self._commands = Commands(np.zeros((1, agents, 2)), idle)
        self._everywhere = np.ones(1, dtype=np.bool_)
        self._ghosts: dict[int, NDArray[np.void]] = {}
        self._is_moved = False  # `advance` is done, `commit` is not
        self.reset(0)

    def _refuse_shared_features(self, config: EnvConfig, network: RoadNetwork) -> None:
        size = self._shared.outputs.observations.shape[2]
        wrong = {
            "v2x, rig, scenario, population.external or signals.overrides": bool(
                self._tick.attached
            ),
            "traffic-actuated signals": network.num_controllers > 0,
            "clock.control_latency_ticks": config.clock.control_latency_ticks > 0,
            "sensors.stack, or an observation with history": carried_from(config.sensors) < size,
            "terms.team_share": config.terms.team_share > 0.0,
            "action.kind = discrete": config.action.kind == "discrete",
        }
        for feature, is_used in wrong.items():
            if is_used:
                raise ConfigError(
                    f"{feature}: worlds over backends do not support this, because their zones "
                    "share only vehicles; turn it off, or run the zones on nodes "
                    "(make_vec(..., nodes=k))"
                )

    def reset(self, seed: int) -> None:
        """Return to tick 0, without vehicles."""
        self._shard.align()
        worlds = self._shard.worlds
        worlds.keys[0], worlds.ticks[0] = world_key(seed, 0, 0), 0
        worlds.num_contacts[0] = 0
        self._ghosts.clear()
        self._commands.controls[...] = 0.0
        self._is_moved = False
        self._write(np.zeros(0, dtype=VEHICLE))
        self._shared.switch_signals(common_of(worlds))

    def spawn(self, vehicles: NDArray[np.void]) -> None:
        """Add owned vehicles VEHICLE (n,)."""
        own = self.read_vehicles()
        for vehicle in vehicles["id"].tolist():
            if vehicle in own["id"] or vehicle in self._ghosts:
                raise ConfigError(
                    f"vehicle {vehicle} is in zone {self.zone} already; destroy it, or remove "
                    "its ghost, first"
                )
        self._write(np.concatenate([own, vehicles]))

    def destroy(self, vehicles: Sequence[int]) -> None:
        """Remove owned vehicles."""
        own = self.read_vehicles()
        for vehicle in vehicles:
            self._check_owned(own, vehicle)
        self._write(own[~np.isin(own["id"], vehicles)])

    def apply_controls(self, controls: Mapping[int, VehicleControl]) -> None:
        """Set the controls of agents' vehicles until the next call."""
        own = self.read_vehicles()
        for vehicle in controls:
            agent = self._check_owned(own, vehicle)["agent"]
            if agent < 0:
                raise ConfigError(f"vehicle {vehicle} has no agent; omit its controls")
        for vehicle, control in controls.items():
            agent = self._check_owned(own, vehicle)["agent"]
            self._commands.controls[0, agent] = control

    def advance(self) -> None:
        """Move the owned vehicles to the next tick."""
        worlds = self._shard.worlds
        if worlds.ticks[0] % self._per_step == 0:
            self._executor.begin_step(self._commands)
        self._executor.advance(self._commands)
        self._tick.leave()
        self._tick.departures.num_queue[:] = 0  # the caller spawns all further vehicles
        self._is_moved = True

    def upsert_ghosts(self, vehicles: NDArray[np.void]) -> None:
        """Add or update ghosts: the present rows VEHICLE (n,) of other zones' vehicles."""
        own = self.read_vehicles()
        if both := set(own["id"].tolist()) & set(vehicles["id"].tolist()):
            raise ConfigError(
                f"vehicle {min(both)}: zone {self.zone} owns it, so it cannot be a ghost; "
                "destroy it first"
            )
        for row in vehicles:
            self._ghosts[int(row["id"])] = row.copy()
        self._write(own)

    def remove_ghosts(self, vehicles: Sequence[int]) -> None:
        """Remove ghosts."""
        for vehicle in vehicles:
            self._ghosts.pop(vehicle, None)
        self._write(self.read_vehicles())

    def commit(self) -> int:
        """End the tick, and return the number of the new one."""
        self._executor.resolve()
        self._executor.commit()
        self._is_moved = False
        worlds = self._shard.worlds
        worlds.ticks[0] += 1
        self._shared.switch_signals(common_of(worlds))
        if worlds.ticks[0] % self._per_step == 0:
            self._tick.sense(self._everywhere)
        return int(worlds.ticks[0])

    def read_vehicles(self) -> NDArray[np.void]:
        """Return a copy of the owned vehicles, VEHICLE (n,)."""
        return self._rows()[: self._shard.worlds.num_owned[0]].copy()

    def read_sensors(self) -> dict[int, NDArray[np.float32]]:
        """Return the latest observation (D,) of each owned vehicle of an agent, by its id."""
        own, outputs = self.read_vehicles(), self._shared.outputs
        driven = own[own["agent"] >= 0]
        return {
            int(row["id"]): outputs.observations[0, row["agent"]].copy()
            for row in driven
            if outputs.present[0, row["agent"]]
        }

    def snapshot(self) -> bytes:
        """Return the state that the next tick depends on."""
        if self._is_moved:
            raise ConfigError(f"zone {self.zone} is in the middle of a tick; call commit first")
        common = common_of(self._shard.worlds)
        ghosts = [*self._ghosts.values()]
        arrays: dict[str, Any] = {
            "vehicles": self.read_vehicles().view(np.uint8),
            "ghosts": np.array(ghosts, dtype=VEHICLE).view(np.uint8),
            "controls": self._commands.controls,
            "observations": self._shared.outputs.observations,
            "present": self._shared.outputs.present,
            **{f"common_{name}": _plain(array) for name, array in common._asdict().items()},
        }
        content = io.BytesIO()
        np.savez(content, allow_pickle=False, **arrays)
        return content.getvalue()

    def restore(self, data: bytes) -> None:
        """Resume from a snapshot of this zone."""
        try:
            saved = dict(np.load(io.BytesIO(data), allow_pickle=False))
            vehicles, ghosts = (
                np.frombuffer(saved.pop(name).tobytes(), VEHICLE) for name in ("vehicles", "ghosts")
            )
            common = common_of(self._shard.worlds)
            targets = [
                (self._commands.controls, saved["controls"]),
                (self._shared.outputs.observations, saved["observations"]),
                (self._shared.outputs.present, saved["present"]),
                *((getattr(common, name), saved[f"common_{name}"]) for name in SharedState._fields),
            ]
            if any(_plain(target).shape != array.shape for target, array in targets):
                raise ValueError("its arrays have different sizes")
        except (ValueError, KeyError, OSError, EOFError, BadZipFile) as error:
            raise MessageError(
                f"zone {self.zone}: this is not a snapshot of this world ({error}); use one of the "
                "same configuration, map and zones"
            ) from error
        self._shard.align()
        self._is_moved = False
        for target, array in targets:
            _plain(target)[...] = array
        self._ghosts = {int(row["id"]): row for row in ghosts}
        self._write(vehicles)

    def _rows(self) -> NDArray[np.void]:
        worlds = self._shard.worlds
        rows: NDArray[np.void] = (worlds.next_rows if self._is_moved else worlds.rows)[0]
        return rows

    def _write(self, own: NDArray[np.void]) -> None:
        """Write owned rows, then ghosts."""
        worlds, rows, num = self._shard.worlds, self._rows(), len(own)
        every = num + len(self._ghosts)
        if every > len(rows):
            raise ConfigError(
                f"zone {self.zone} has {every} vehicles and ghosts, but room for {len(rows)}; "
                "increase population.background"
            )
        rows[:num] = own
        for place, ghost in enumerate(self._ghosts.values(), num):
            rows[place] = ghost
        worlds.num_owned[0], worlds.num_rows[0], worlds.num_near[0] = num, every, every
        worlds.step_at[0, :every] = 0  # steps of routes are looked up again
        worlds.num_outer[0] = -1

    def _check_owned(self, own: NDArray[np.void], vehicle: int) -> np.void:
        found = own[own["id"] == vehicle]
        if not len(found):
            ghost = self._ghosts.get(vehicle)
            owner = "another zone" if ghost is None else f"zone {ghost['owner']}"
            raise ConfigError(f"vehicle {vehicle}: zone {self.zone} does not own it; call {owner}")
        row: np.void = found[0]
        return row


def _plain(array: NDArray[np.generic]) -> NDArray[np.generic]:
    """Return records as bytes, which NumPy can save without pickles."""
    return array.view(np.uint8) if array.dtype.names else array
