"""Upside-Down Reinforcement Learning (Srivastava et al. 2019): the algorithm, without messaging.

:func:`train` trains an agent, :func:`load` loads one. The paper's parts are in these modules:

================================  ======================================
Algorithm 1                       :mod:`udrl.algorithm1`
2.3.1 replay buffer               :mod:`udrl.replay_buffer`
2.3.2 behavior function           :mod:`udrl.behavior`
2.3.3 training                    :mod:`udrl.segments`, :mod:`udrl.experience`, :mod:`udrl.training`
2.3.4 exploratory commands        :mod:`udrl.commands`
2.3.5 experience, Algorithm 2     :mod:`udrl.acting`
2.3.6 evaluation                  :mod:`udrl.commands`, :mod:`udrl.evaluation`
Algorithm 2, step by step         :mod:`udrl.policy`, :mod:`udrl.rollout`
3.1, 3.4 environments             :mod:`udrl.environments`
Table 2 hyperparameters           :mod:`udrl.config`, :mod:`udrl.setting_groups`
================================  ======================================
"""

from importlib.metadata import entry_points
from types import ModuleType
from typing import TYPE_CHECKING, Any

from udrl.version import __version__ as __version__

if TYPE_CHECKING:
    from udrl_inspect.agents import load as load
    from udrl_launch.api import train as train

__all__ = ["__version__", "load", "train"]

#: Entry points of functions that packages above this one define.
_GROUP = "udrl"


def __getattr__(name: str) -> Any:
    """Return a function of a package above this one; it is imported on first use."""
    for found in entry_points(group=_GROUP, name=name):
        return found.load()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    modules = [name for name, value in globals().items() if isinstance(value, ModuleType)]
    special = [name for name in globals() if name.startswith("__")]
    return sorted({*__all__, *modules, *special})
