"""Clients read the present speed limits, including limits that the world has changed."""

from __future__ import annotations

import numpy as np

from cavmarl.config.world_spec import WorldSpec
from cavmarl.cosim.carla.carla_server import CarlaServer
from cavmarl.cosim.carla.hosted_world import LoadedWorlds


def test_vehicles_on_a_damaged_road_have_its_speed_limit() -> None:
    spec = WorldSpec.of("grid4x4", agents=3, background=30, overrides={"map.changed_lanes": 8})
    with CarlaServer(LoadedWorlds(spec), port=0) as server:
        session = server.session
        world = session.world
        session.tick()
        network = world.env.network
        edges = network.lanes["edge"][world.rows["lane"]]
        roads = edges[~network.lanes["internal"][world.rows["lane"]]]
        road = int(np.bincount(roads).argmax())
        world.env.damage_road(network.edge_ids[road], 5.0)
        session.tick()
        on_road = network.lanes["edge"][world.rows["lane"]] == road
        limits = session.actors.vehicle_states["speed_limit"]
        assert on_road.any()
        assert np.allclose(limits[on_road], 18.0)
        usual = 3.6 * network.lanes["speed_mps"][world.rows["lane"]]
        assert np.allclose(limits[~on_road], usual[~on_road])
