"""`MovingOff`: teaches vehicles that stand without a reason to move off.

Where a vehicle stands and brakes, random actions of single steps hardly move it, so PPO receives no
gradient, and vehicles may wait for each other until their trips end. `MovingOff` finds such
decisions, and pulls their throttle up.
"""

from __future__ import annotations

from torch import Tensor

from cavmarl.config.action import ActionConfig
from cavmarl.config.sensors import SensorsConfig
from cavmarl.core.errors import ConfigError
from cavmarl.sensors.kernels.sense import SPEED_SCALE
from cavmarl.sensors.observed import feature_names

STANDING_MPS = 0.5  # slower vehicles stand
GOES = 0.1  # the built-in driver moves off with a throttle above this
THROTTLE = 0.3  # throttle up to which the driver is pulled


class MovingOff:
    """Finds vehicles that stand although the built-in driver would go.

    Vehicles before a red or yellow signal are left out: the built-in driver would close up there.
    """

    def __init__(self, sensors: SensorsConfig, action: ActionConfig) -> None:
        """Find the features.

        Raises:
            ConfigError: there is no `ego` sensor, frames are stacked, or actions are discrete.
        """
        names = feature_names(sensors)
        if ("ego", "speed") not in names or sensors.stack > 1 or action.kind != "continuous":
            raise ConfigError(
                "--move-off-weight: needs sensors.ego.enabled true, sensors.stack 1 and "
                "action.kind continuous; leave the option out or change the environment"
            )
        self._speed = names.index(("ego", "speed"))
        stops = [("way", "line_red_0"), ("way", "line_yellow_0")]
        self._stops = [names.index(name) for name in stops if name in names]

    def reluctant(self, observations: Tensor, suggested: Tensor) -> Tensor:
        """Return which (N,) vehicles should move off.

        `observations` (N, D); `suggested` (N, 2): actions of the driver to imitate.
        """
        standing = observations[:, self._speed] < STANDING_MPS / SPEED_SCALE
        held = (observations[:, self._stops] > 0.0).any(1)
        return standing & ~held & (suggested[:, 0] > GOES)


def move_off_loss(output: Tensor, reluctant: Tensor) -> Tensor:
    """Return the mean of the squared lack of throttle; it is 0 for vehicles not in `reluctant`.

    The mean is over all N vehicles. `output` (N, 2): means of the actions. `reluctant` (N,): which
    vehicles should move off.
    """
    lack: Tensor = (THROTTLE - output[:, 0]).relu().square() * reluctant
    return lack.mean()


def is_held_back(output: Tensor) -> Tensor:
    """Return which (N,) vehicles would get less throttle than `THROTTLE`."""
    held: Tensor = output[:, 0] < THROTTLE
    return held
