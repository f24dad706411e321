"""A server to which CARLA's own client connects: calls, snapshots, actors and sensors.

`serve` runs a world; docs/tutorials/carla_client.md shows a client.
"""

from cavmarl.cosim.carla.carla_server import CarlaServer, serve
from cavmarl.cosim.carla.carla_session import SessionLimits

__all__ = ["CarlaServer", "SessionLimits", "serve"]
