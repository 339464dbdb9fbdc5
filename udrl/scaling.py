"""Scales of desired return and horizon that fit an environment.

The network reads a command as numbers of about 1 (section 3.2 scales both, by hand). Where they are
left open, random episodes played before a run begins say how large returns and lengths are.
"""

from collections.abc import Sequence

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.commands import CommandSampler
from udrl.config import Config, change
from udrl.episode import Episode

#: Random episodes that are looked at.
_EPISODES = 20
#: What the network reads well.
_LEAST, _MOST = 0.1, 10.0


def settle_scales(
    config: Config, generator: EpisodeGenerator, episodes: Sequence[Episode] | None = None
) -> Config:
    """Return settings in which no scale is ``auto``.

    ``return_scale`` becomes 1 / the greatest return, or difference of returns, whichever is more (1
    where there is none), ``horizon_scale`` 1 / the mean length.

    Args:
        config: the settings of a new run.
        generator: plays the first commands of its warm-up.
        episodes: to look at instead.

    Raises:
        EnvironmentFault: the environment failed three times under the same command.
    """
    network = config.network
    if network.return_scale != "auto" and network.horizon_scale != "auto":
        return config
    if episodes is None:
        commands = CommandSampler(config, generator.spec).warm_up()[:_EPISODES]
        episodes = generate_episodes(generator, commands, None)
    returns = [e.episode_return for e in episodes]
    reach = max(*map(abs, returns), max(returns) - min(returns), 0.0)
    length = sum(e.length for e in episodes) / len(episodes)
    found = {
        "return_scale": _rounded(1 / reach) if reach else 1.0,
        "horizon_scale": _rounded(1 / length),
    }
    return change(config, **{n: v for n, v in found.items() if getattr(network, n) == "auto"})


def fits(scale: float, size: float) -> bool:
    """Say whether a scale makes a number that a network reads well of what is usual."""
    return size == 0 or _LEAST <= scale * size <= _MOST


def _rounded(scale: float) -> float:
    """Return a scale that is possible, with two digits."""
    possible = min(max(scale, 1e-6), 1e6)
    return float(f"{possible:.2g}")
