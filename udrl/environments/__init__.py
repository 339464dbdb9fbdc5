"""Environments: those of the paper that Gymnasium lacks, and the adapter for all others.

Importing this package registers these environments with Gymnasium: ``TakeCover-v0`` (section 3.1),
``Doom-v0`` (any ViZDoom scenario), ``LunarLanderSparse-v3`` (section 3.4), ``Figure2-v0`` (the
paper's toy example) and ``Obedience-v0`` (following the command is trivial).
"""

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

from udrl.environments.adapter import Environment
from udrl.environments.downsampling import Downsample
from udrl.environments.making import make_environment
from udrl.environments.sparse import RewardAtEnd
from udrl.environments.specification import EnvironmentSpec, specify
from udrl.environments.step_limits import limit_steps

__all__ = [
    "Downsample",
    "Environment",
    "EnvironmentSpec",
    "limit_steps",
    "make_environment",
    "specify",
]

_DOOM = "udrl.environments.doom:Doom"
_SPECS = (
    EnvSpec(
        "LunarLanderSparse-v3",
        entry_point="gymnasium.envs.box2d.lunar_lander:LunarLander",
        max_episode_steps=1000,
        additional_wrappers=(RewardAtEnd.wrapper_spec(),),
    ),
    EnvSpec("Doom-v0", entry_point=_DOOM),
    EnvSpec(
        "TakeCover-v0",
        entry_point=_DOOM,
        max_episode_steps=2100,
        kwargs={"scenario": "take_cover", "max_return": 2100.0},
    ),
    EnvSpec("Figure2-v0", entry_point="udrl.environments.figure2:Figure2", max_episode_steps=2),
    EnvSpec(
        "Obedience-v0", entry_point="udrl.environments.obedience:Obedience", max_episode_steps=16
    ),
)
for _spec in _SPECS:
    gym.registry.setdefault(_spec.id, _spec)
