"""The differences between the versions of CARLA's client that a server must know.

A client does not send its version, so the server is configured for one version.
"""

from __future__ import annotations

from typing import NamedTuple

from cavmarl.core.errors import ConfigError


class ClientVersion(NamedTuple):
    """One version of the client."""

    name: str
    snapshot_kind: int  # number of a snapshot among the kinds of frames
    first_attribute_kind: int  # number of the attribute kind `bool`
    box_has_actor: bool  # a bounding box has a fourth field
    has_wheel_physics: bool  # `VehiclePhysicsControl` has the layout of 0.9
    is_mercator: bool  # how places are projected; see `carla_geodesy`


CLIENT_VERSIONS = {
    version.name: version
    for version in (
        ClientVersion("0.9.15", 16, 0, False, True, True),
        ClientVersion("0.9.16", 17, 1, True, True, False),
        ClientVersion("0.10.0", 16, 0, False, False, True),
    )
}
DEFAULT_VERSION = "0.9.16"


def client_version(name: str) -> ClientVersion:
    """Return a version by its name; raise ConfigError if it is not supported."""
    if name not in CLIENT_VERSIONS:
        known = ", ".join(CLIENT_VERSIONS)
        raise ConfigError(f"client version {name!r}: must be one of {known}")
    return CLIENT_VERSIONS[name]
