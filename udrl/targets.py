"""Targets: what a command requires, how it counts down, and how the networks read it."""

import math

import numpy as np
import numpy.typing as npt

from udrl.setting_groups import NetworkSettings

#: Targets, one per row: float64 [rows, ReturnInTime.size].
Desired = npt.NDArray[np.float64]


class ReturnInTime:
    """The paper's target: a desired return within a desired horizon (section 2.2).

    Args:
        network: ``return_scale``, ``horizon_scale``, ``horizon_equals_return``.

    Attributes:
        horizon_follows: whether the horizon always equals the desired return, as an integer
            (section 3.1, TakeCover).
        least: lower bounds of return and horizon at the networks' input. In acting, the horizon
            counts down below the values seen in training.
    """

    #: Numbers per target.
    size = 2

    def __init__(self, network: NetworkSettings) -> None:
        self.horizon_follows = network.horizon_equals_return
        self.least = (1.0 if self.horizon_follows else -math.inf, 1.0)
        self._network = network

    @property
    def has_horizon(self) -> bool:
        """Whether the desired horizon has an effect of its own."""
        return not self.horizon_follows and self._network.horizon_scale > 0

    @property
    def scales(self) -> tuple[float, float]:
        """Factors on return and horizon at the networks' input (section 3.2)."""
        return self._network.return_scale, self._network.horizon_scale

    def initial(self, desired_return: float, desired_horizon: int) -> tuple[float, int]:
        """Return c_0: the horizon is at least 1; if it follows the return, both are integers."""
        if self.horizon_follows:
            desired_horizon = max(1, min(math.floor(desired_return), 2**31))
            desired_return = float(desired_horizon)
        return desired_return, max(1, desired_horizon)

    def advance(self, desired: Desired, reward: npt.NDArray[np.float32]) -> None:
        """Count down in place, after a step: lines 8, 9 and 11 of Algorithm 2.

        Args:
            desired: the targets.
            reward: r_t, float32 [rows].
        """
        desired[:, 0] -= reward
        desired[:, 1] -= 1.0

    def bound(self, desired: Desired, cap: npt.NDArray[np.float64]) -> None:
        """Cap desired returns in place, at ``cap``, float64 [rows] (section 2.3.2)."""
        np.minimum(desired[:, 0], cap, out=desired[:, 0])
