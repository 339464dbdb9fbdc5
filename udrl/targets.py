"""What a command asks for, how it counts down, and how the networks read it."""

import math

import numpy as np
import numpy.typing as npt

from udrl.setting_groups import NetworkSettings

#: Rows of what is desired: float64 [rows, ReturnInTime.size].
Desired = npt.NDArray[np.float64]


class ReturnInTime:
    """The paper's: a desired return within a desired horizon (section 2.2).

    Args:
        network: ``return_scale``, ``horizon_scale``, ``desired_horizon``.

    Attributes:
        horizon_follows: the horizon is the desired return, as an integer, always (section 3.1,
            TakeCover).
        least: what return and horizon are raised to before they are read; in acting the horizon
            counts down beyond what was seen in training.
    """

    #: Numbers of a target.
    size = 2

    def __init__(self, network: NetworkSettings) -> None:
        self.horizon_follows = network.desired_horizon == "return"
        self.least = (1.0 if self.horizon_follows else -math.inf, 1.0)
        self._network = network

    @property
    def has_horizon(self) -> bool:
        """Whether it makes a difference which horizon is desired."""
        return not self.horizon_follows and self._network.horizon_scale > 0

    @property
    def scales(self) -> tuple[float, float]:
        """Factors on return and horizon at the networks' input (section 3.2)."""
        return self._network.return_scale, self._network.horizon_scale

    def settle(self, desired_return: float, desired_horizon: int) -> tuple[float, int]:
        """Return c_0 as it is said: with a horizon of 1 at least, and one that follows."""
        if self.horizon_follows:
            desired_horizon = max(1, min(math.floor(desired_return), 2**31))
            desired_return = float(desired_horizon)
        return desired_return, max(1, desired_horizon)

    def advance(self, desired: Desired, reward: npt.NDArray[np.float32]) -> None:
        """Count down in place, after a step: lines 8, 9 and 11 of Algorithm 2.

        Args:
            desired: of each row.
            reward: r_t, float32 [rows].
        """
        desired[:, 0] -= reward
        desired[:, 1] -= 1.0

    def bound(self, desired: Desired, cap: npt.NDArray[np.float64]) -> None:
        """Lower desired returns to a cap, float64 [rows], in place (section 2.3.6)."""
        np.minimum(desired[:, 0], cap, out=desired[:, 0])
