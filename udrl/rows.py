"""Many environments side by side, stepped one after another in one thread."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from udrl.config import Config
from udrl.environments.adapter import Environment
from udrl.environments.making import indexed, make_environment
from udrl.environments.specification import EnvironmentSpec, specify
from udrl.environments.step_limits import limit_steps
from udrl.spaces import Observations


class Step(NamedTuple):
    """Episodes that ended in a step, regularly or by an exception.

    Attributes:
        ended: row, terminated and truncated of each episode that ended.
        failed: row and exception of each environment that raised one.
    """

    ended: list[tuple[int, bool, bool]]
    failed: list[tuple[int, Exception]]


class Rows:
    """``n`` environments of a run.

    Args:
        config: the run's settings.
        n: number of environments.
        make: factory of environments.
        first_index: index of the first environment (:data:`udrl.environments.making.INDEX`).

    Attributes:
        spec: specification of the environment.
        observation: last observation of each row, [n, *observation_shape].
        reward: last reward of each row, float32 [n].

    Raises:
        UnsupportedEnvironment: the environment cannot be created or is not supported.
    """

    def __init__(
        self,
        config: Config,
        n: int,
        make: Callable[[Config], Environment] = make_environment,
        first_index: int = 0,
    ) -> None:
        self._config = config
        self._make = make
        self._first_index = first_index
        self._envs: list[Environment] = []
        try:
            for row in range(n):
                self._envs.append(self._make_row(row))
            self.spec: EnvironmentSpec = specify(self._envs[0], config)
        except BaseException:
            self.close()
            raise
        self._limits = [self.spec.max_episode_steps] * n
        space = self.spec.observation_space
        self.observation: Observations = np.zeros((n, *space.shape), space.dtype)
        self.reward = np.zeros(n, np.float32)

    def reset(self, row: int, seed: int, max_steps: int) -> Exception | None:
        """Begin an episode; return the exception if the environment raises one."""
        try:
            if self._limits[row] != max_steps:
                limit_steps(self._envs[row], max_steps)
                self._limits[row] = max_steps
            self.observation[row], _ = self._envs[row].reset(seed=seed)
        except Exception as error:  # noqa: BLE001 - the environment is foreign code
            return error
        self.reward[row] = 0.0
        return None

    def step(self, rows: Sequence[int], actions: npt.NDArray[np.integer]) -> Step:
        """Take a step in some of the environments.

        Args:
            rows: the rows of these environments.
            actions: actions of all rows, [n, *action_shape]; only those of ``rows`` are used.
        """
        observation, reward, envs = self.observation, self.reward, self._envs
        ended: list[tuple[int, bool, bool]] = []
        failed: list[tuple[int, Exception]] = []
        chosen = actions.tolist()
        for row in rows:
            try:
                observation[row], reward[row], terminated, truncated, _ = envs[row].step(
                    chosen[row]
                )
            except Exception as error:  # noqa: BLE001 - the environment is foreign code
                failed.append((row, error))
                continue
            if terminated or truncated:
                ended.append((row, bool(terminated), bool(truncated)))
        return Step(ended, failed)

    def replace(self, row: int) -> None:
        """Replace a failed environment with a new one.

        Raises:
            UnsupportedEnvironment: the environment can no longer be created.
        """
        self._envs[row].close()
        self._envs[row] = self._make_row(row)
        self._limits[row] = self.spec.max_episode_steps

    def _make_row(self, row: int) -> Environment:
        with indexed(self._first_index + row):
            return self._make(self._config)

    def close(self) -> None:
        """Close all environments."""
        for env in self._envs:
            env.close()
