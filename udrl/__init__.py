"""Upside-Down Reinforcement Learning (Srivastava et al. 2019): the algorithm, free of messaging.

The paper's parts and where they live:

================================  ======================================
Algorithm 1                       :mod:`udrl.algorithm1`
2.3.1 replay buffer               :mod:`udrl.replay`
2.3.2 behavior function           :mod:`udrl.behavior`
2.3.3 training                    :mod:`udrl.segments`, :mod:`udrl.training`
2.3.4 exploratory commands        :mod:`udrl.commands`
2.3.5 experience, Algorithm 2     :mod:`udrl.acting`
2.3.6 evaluation                  :mod:`udrl.commands`, :mod:`udrl.evaluation`
Algorithm 2, step by step         :mod:`udrl.policy`, :mod:`udrl.rollout`
3.1, 3.4 environments             :mod:`udrl.environments`
Table 2 hyperparameters           :mod:`udrl.config`, :mod:`udrl.setting_groups`
================================  ======================================
"""

from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any

from udrl.version import __version__ as __version__

if TYPE_CHECKING:
    from udrl.folder import load as load
    from udrl_launch.api import train as train


def __getattr__(name: str) -> Any:
    """Return what packages above this one offer here; it is imported when it is wanted."""
    for offered in entry_points(group="udrl", name=name):
        return offered.load()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
