"""Settings that fit an environment, chosen by what random episodes in it show.

What suits an environment depends on how long its episodes are and how large its returns. Settings
that are left open (``auto``, :data:`OPEN`) are chosen when a run is created, from random episodes
that are played for it. A :class:`udrl.config.Config` holds the choice.
"""

import math
from collections.abc import Collection, Sequence
from contextlib import closing
from hashlib import blake2b

import msgspec

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.commands import CommandSampler
from udrl.config import OPEN, Config, change
from udrl.episode import Episode
from udrl.offline import settle_dataset

#: Random episodes that are looked at: so many, and more until there are enough env steps; fewer if
#: they are long.
_EPISODES, _MOST_EPISODES, _STEPS, _PLENTY = 40, 500, 1_000, 10_000
#: Steps of an episode that are looked at.
_LONGEST = 2_000
#: Steps for which a random action may be held, and how many of the best episodes count.
_HOLDS, _COUNT = (2, 8, 32), 3
#: With what probability a random action begins at a step: where chance decides, and elsewhere.
_RATE_BY_CHANCE, _RATE = 0.15, 0.05
#: What the network reads well.
_LEAST, _MOST = 0.1, 10.0
#: Fewest episodes and env steps of the warm-up: where a reward is rare, one must be found by chance
#: before there is anything to learn from.
_WARM_UP, _WARM_UP_STEPS = 50, 4_000
#: Lambda of the lambda-returns: they reach over a quarter of a random episode, at the least.
_LEAST_LAMBDA, _REACH = 0.95, 4.0


def fit(config: Config, left_open: Collection[str]) -> Config:
    """Return the settings of a new run, with those chosen that were left open.

    The environment is made once, and only if anything is open.

    Args:
        config: the settings; the values of open ones have no meaning.
        left_open: names of open ones, among :data:`udrl.config.OPEN`.

    Raises:
        ConfigError: the settings contradict what was chosen, or the dataset cannot be used.
        UnsupportedEnvironment: the environment does not exist or is not supported.
        EnvironmentFault: the environment failed three times under the same command.
    """
    if not left_open:
        return config
    with closing(EpisodeGenerator(config, 1)) as generator:
        _, offline = settle_dataset(config, generator.spec)
        return choose(config, left_open, generator, offline)


def choose(
    config: Config,
    left_open: Collection[str],
    generator: EpisodeGenerator,
    episodes: Sequence[Episode] | None = None,
) -> Config:
    """Return settings with the open ones chosen.

    Args:
        config: the settings; the values of open ones have no meaning.
        left_open: names of open ones, among :data:`udrl.config.OPEN`.
        generator: plays the first commands of the warm-up.
        episodes: to look at instead.

    Raises:
        ConfigError: the settings contradict what was chosen.
        EnvironmentFault: the environment failed three times under the same command.
    """
    assert OPEN.keys() >= set(left_open)
    hold, n_warm_up = config.commands.warm_up_hold, config.commands.n_warm_up_episodes
    if episodes is not None:
        sample = Sample()
        for episode in episodes:
            sample.add(episode)
    elif {"warm_up_hold", "hold_steps"}.isdisjoint(left_open):
        sample = _play(config, generator, hold)
    else:
        hold, sample = _best_hold(config, generator)
    returns, length = sample.returns, sum(sample.lengths) / len(sample.lengths)
    reach = max(*map(abs, returns), max(returns) - min(returns), 0.0)
    if episodes is None:
        n_warm_up = max(_WARM_UP, math.ceil(_WARM_UP_STEPS / length))
    baseline = "action_value" if sample.by_chance else "value"
    if config.training.segments == "all":
        baseline = "none"  # no other goes with them
    chosen = {
        # An agent that does not see a step limit cannot plan for it. Where episodes end long before
        # it, the time left says little, and agents that saw it learned more slowly.
        "observe_time": 2 * length > _limit(config, generator),
        "return_scale": _rounded(1 / reach) if reach else 1.0,
        # How long an episode lasts is luck too, and one that is asked to be short would gamble.
        "horizon_scale": 0.0 if sample.by_chance else _rounded(1 / length),
        "baseline": baseline,
        "return_lambda": max(_LEAST_LAMBDA, round(1 - _REACH / length, 3)),
        "n_warm_up_episodes": n_warm_up,
        "warm_up_hold": hold,
        # Averages need all actions to be tried again and again.
        "held_actions": 0.5 if sample.by_chance else 0.25,
        "held_rate": _RATE_BY_CHANCE if sample.by_chance else _RATE,
        "hold_steps": hold,
    }
    return change(config, **{name: chosen[name] for name in left_open})


class Sample:
    """What episodes show; they are not kept.

    Attributes:
        returns: of each.
        lengths: of each, steps.
        by_chance: whether the same action after the same observation had different consequences. By
            chance, or by what is not observed: an agent cannot tell. Where no observation comes
            twice, nothing can be said, and the answer is no.
    """

    def __init__(self) -> None:
        self.returns: list[float] = []
        self.lengths: list[int] = []
        self.by_chance = False
        self._consequences: dict[bytes, bytes] = {}

    def best(self) -> list[float]:
        """Return the returns of the best few, the least first."""
        return sorted(self.returns)[-_COUNT:]

    def add(self, episode: Episode) -> None:
        """Look at an episode."""
        self.returns.append(episode.episode_return)
        self.lengths.append(episode.length)
        seen = [blake2b(o.tobytes(), digest_size=16).digest() for o in episode.observations]
        # What would have followed after a truncation is not known.
        for t in range(episode.length - episode.truncated):
            done = seen[t] + episode.actions[t].tobytes()
            follows = episode.rewards[t].tobytes() + b"".join(seen[t + 1 : t + 2])
            self.by_chance |= self._consequences.setdefault(done, follows) != follows


def _best_hold(config: Config, generator: EpisodeGenerator) -> tuple[int, Sample]:
    """Return for how many steps random actions should be held, and episodes in which they are.

    Where one step moves little, actions that change at every step cancel each other, and hardly any
    random episode obtains more than the usual. Only there they are held: for as many steps as let
    the best few of some episodes obtain most, and all of these few more than the usual. If in
    doubt, 1; and where chance decides, which might do the same.
    """
    sample = _play(config, generator, 1)
    ordered = sorted(sample.returns)
    usual = ordered[len(ordered) // 2]
    found = {1: sample}
    if ordered[-_COUNT] <= usual and not sample.by_chance:
        held = {hold: _play(config, generator, hold) for hold in _HOLDS}
        found |= {hold: one for hold, one in held.items() if one.best()[0] > usual}
    best = max(found, key=lambda hold: sum(found[hold].best()))
    return best, found[best]


def _play(config: Config, generator: EpisodeGenerator, hold: int) -> Sample:
    """Play the first commands of the warm-up, with random actions held for ``hold`` steps."""
    sampler = CommandSampler(change(config, n_warm_up_episodes=_MOST_EPISODES), generator.spec)
    sample = Sample()
    for n, command in enumerate(sampler.warm_up()):
        steps = sum(sample.lengths)
        if steps >= (_PLENTY if n < _EPISODES else _STEPS):
            break
        played = msgspec.structs.replace(
            command, random_hold=hold, max_steps=min(command.max_steps, _LONGEST)
        )
        sample.add(*generate_episodes(generator, [played], None))
    return sample


def fits(scale: float, size: float) -> bool:
    """Say whether a scale makes a number that a network reads well of what is usual."""
    return 0.0 in (size, scale) or _LEAST <= scale * size <= _MOST


def _limit(config: Config, generator: EpisodeGenerator) -> int:
    """Return how many steps of a random episode are looked at, at most."""
    training = config.max_train_steps or _LONGEST
    return min(generator.spec.max_episode_steps, training, _LONGEST)


def _rounded(scale: float) -> float:
    """Return a scale that is possible, with two digits."""
    possible = min(max(scale, 1e-6), 1e6)
    return float(f"{possible:.2g}")
