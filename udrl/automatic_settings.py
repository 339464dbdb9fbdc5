"""Automatic settings: values chosen from random episodes of the environment.

Good values depend on the length of episodes and on the magnitude of returns. Settings that are
``auto`` (:data:`udrl.config.AUTOMATIC`) are chosen when a run is created, from random episodes. A
:class:`udrl.config.Config` holds the chosen values.
"""

import logging
import math
from collections.abc import Collection, Sequence
from contextlib import closing
from hashlib import blake2b
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.actions import Actions, random_actions
from udrl.commands import CommandSampler
from udrl.config import AUTOMATIC, Config, change
from udrl.datasets import resolve_dataset
from udrl.environments.adapter import Adapter
from udrl.environments.making import make_environment
from udrl.environments.masking import MASK, mask_in
from udrl.environments.specification import specify
from udrl.episode import Episode
from udrl.setting_groups import CommandSettings
from udrl.spaces import parts_of

log = logging.getLogger("udrl")

#: Reset seed for the check whether the environment has an action mask, from the training range.
_SEED = 1_000_000
#: Usual and maximum number of random episodes to sample.
_EPISODES, _MAX_EPISODES = 40, 500
#: Env steps at which sampling stops: after the usual number of episodes, and before.
_STEPS, _MAX_STEPS = 1_000, 10_000
#: Upper bound of the step limit of sampled episodes, in steps.
_MAX_LENGTH = 2_000
#: Candidates for the steps for which random actions are held; number of best episodes to compare.
_HOLDS, _N_BEST = (2, 8, 32), 3
#: ``hold_rate`` in stochastic and in other environments.
_STOCHASTIC_RATE, _RATE = 0.15, 0.05
#: Range of input magnitudes from which a network learns well.
_MIN_INPUT, _MAX_INPUT = 0.1, 10.0
#: Minimum episodes and env steps of the warm-up. If rewards are rare, random actions must find one
#: before there is anything to learn from.
_WARM_UP, _WARM_UP_STEPS = 50, 4_000
#: ``max_age`` and ``replay_size`` if rewards are not rare: the buffer keeps all episodes of a
#: window of iterations, which are fewer than ``replay_size``.
_MAX_AGE, _ALL = 12, 12_000
#: Rewards are rare if random play is expected to leave fewer than _FEWEST episodes above the median
#: in this window, which would drop them before it has enough. The buffer then keeps the _BEST
#: episodes of all time and the _NEWEST.
_FEWEST, _BEST, _NEWEST = 10, 100, 60
#: ``guidance_kl`` and ``reset_every`` if rewards are rare. Few examples then show what a high
#: return takes, so the agent responds weakly to it, and its network overfits to the first of them.
_RARE_GUIDANCE, _RARE_RESETS = 0.1, 100
#: Minimum ``return_lambda``. Lambda-returns reach over at least 1 / _REACH of a random episode.
_MIN_LAMBDA, _REACH = 0.95, 4.0


def resolve_automatic(config: Config, automatic: Collection[str]) -> Config:
    """Return the settings of a new run, with values for the automatic ones.

    This makes one environment, and only if a setting is automatic.

    Args:
        config: the settings; the values of automatic ones are ignored.
        automatic: names of the automatic settings, among :data:`udrl.config.AUTOMATIC`.

    Raises:
        ConfigError: the settings are not compatible with the chosen values, or the dataset cannot
            be used.
        UnsupportedEnvironment: the environment does not exist or is not supported.
        EnvironmentFault: the environment failed three times under the same command.
    """
    if not automatic:
        return config
    config = with_offered_mask(config, automatic)
    with closing(EpisodeGenerator(config, 1)) as generator:
        _, offline = resolve_dataset(config, generator.spec)
        return choose(config, automatic, generator, offline)


def choose(
    config: Config,
    automatic: Collection[str],
    generator: EpisodeGenerator,
    episodes: Sequence[Episode] | None = None,
) -> Config:
    """Return settings with values for the automatic ones.

    Args:
        config: the settings; the values of automatic ones are ignored, but for ``action_mask``, on
            which random episodes depend (:func:`with_offered_mask`).
        automatic: names of the automatic settings, among :data:`udrl.config.AUTOMATIC`.
        generator: runs the first commands of the warm-up.
        episodes: episodes to use instead of these.

    Raises:
        ConfigError: the settings are not compatible with the chosen values.
        EnvironmentFault: the environment failed three times under the same command.
    """
    assert AUTOMATIC.keys() >= set(automatic)
    hold, n_warm_up = config.commands.warm_up_hold_steps, config.commands.n_warm_up_episodes
    if episodes is not None:
        sample = Sample()
        for episode in episodes:
            sample.add(episode)
    elif {"warm_up_hold_steps", "hold_steps"}.isdisjoint(automatic):
        sample = _play(config, generator, hold)
    else:
        hold, sample = _best_hold(config, generator)
    returns, length = sample.returns, sum(sample.lengths) / len(sample.lengths)
    magnitude = max(*map(abs, returns), max(returns) - min(returns), 0.0)
    if episodes is None:
        n_warm_up = max(_WARM_UP, math.ceil(_WARM_UP_STEPS / length))
    stochastic = sample.is_stochastic
    baseline = "action_value" if stochastic else "value"
    if config.training.segments == "all":
        baseline = "none"  # the only one that all segments allow
    rare = episodes is None and rewards_are_rare(sample, config.commands)
    chosen = {
        "action_mask": config.actions.action_mask,
        # To plan for the step limit, an agent must observe the time left. If episodes usually end
        # long before the limit, agents that observe it learn more slowly.
        "observe_time": 2 * length > _limit(config, generator),
        "return_scale": _rounded(1 / magnitude) if magnitude else 1.0,
        # Short episodes are partly luck; given a short horizon, the agent would take risks.
        "horizon_scale": 0.0 if stochastic else _rounded(1 / length),
        "baseline": baseline,
        "return_lambda": max(_MIN_LAMBDA, round(1 - _REACH / length, 3)),
        "n_warm_up_episodes": n_warm_up,
        "warm_up_hold_steps": hold,
        "replay_size": max(_BEST, config.commands.last_few) if rare else _ALL,
        "recent_size": _NEWEST if rare else 0,
        "max_age": None if rare else _MAX_AGE,
        "guidance_kl": _RARE_GUIDANCE if rare else 0.0,
        "reset_every": _RARE_RESETS if rare else None,
        # To estimate average outcomes, all actions must be tried repeatedly.
        "hold_share": 0.5 if stochastic else 0.25,
        "hold_rate": _STOCHASTIC_RATE if stochastic else _RATE,
        "hold_steps": hold,
    }
    return change(config, **{name: chosen[name] for name in automatic})


def with_offered_mask(config: Config, automatic: Collection[str]) -> Config:
    """Return settings with the environment's own action mask, if it has one and this is automatic.

    The mask is the entry ``action_mask`` of the observation, or else of ``info``.

    Args:
        config: the settings.
        automatic: names of the automatic settings.

    Raises:
        UnsupportedEnvironment: the environment does not exist or is not supported.
    """
    if "action_mask" not in automatic or config.commands.dataset is not None:
        return config
    with closing(make_environment(config)) as env:
        for place in (MASK, "info"):
            masked = change(config, action_mask=place)
            try:
                _take_allowed_action(env, masked)
            except Exception as error:  # noqa: BLE001 - random episodes will show other faults
                log.debug("%s has no action mask in %s: %s", config.environment, place, error)
            else:
                return masked
    return config


def _take_allowed_action(env: Adapter, config: Config) -> None:
    """Begin an episode without a mask's wrapper, and take an action that the mask allows.

    Raises:
        UnsupportedEnvironment: no entry of the observation can be a mask.
        EnvironmentFault: the mask is absent or invalid.
    """
    actions = env.actions.plain
    leaf = None if config.actions.action_mask == "info" else specify(env, config).action_mask

    def mask(observation: npt.NDArray[Any], info: Any, where: str, *, is_over: bool) -> Actions:
        given = info if leaf is None else {MASK: parts_of(observation)[leaf]}
        return mask_in(given, actions.components, where, is_over=is_over)

    allowed = mask(*env.reset(seed=_SEED), "reset", is_over=False)
    (action,) = random_actions(actions, allowed[None], np.zeros((1, *actions.shape)))
    observation, _, terminated, truncated, info = env.step(action)
    mask(observation, info, "step", is_over=terminated or truncated)


class Sample:
    """Statistics of episodes; the episodes are not kept.

    Attributes:
        returns: return of each episode.
        lengths: length of each episode, in steps.
        is_stochastic: whether the same action after the same observation had different outcomes:
            the environment is stochastic, or only partially observed, which looks the same to an
            agent. False if no observation occurs twice.
    """

    def __init__(self) -> None:
        self.returns: list[float] = []
        self.lengths: list[int] = []
        self.is_stochastic = False
        self._outcomes: dict[bytes, bytes] = {}

    def best(self) -> list[float]:
        """Return the best few returns, lowest first."""
        return sorted(self.returns)[-_N_BEST:]

    def add(self, episode: Episode) -> None:
        """Add an episode to the statistics."""
        self.returns.append(episode.episode_return)
        self.lengths.append(episode.length)
        seen = [blake2b(o.tobytes(), digest_size=16).digest() for o in episode.observations]
        # The outcome of a last step that did not terminate is unknown.
        for t in range(episode.length - (not episode.terminated)):
            step = seen[t] + episode.actions[t].tobytes()
            outcome = episode.rewards[t].tobytes() + b"".join(seen[t + 1 : t + 2])
            self.is_stochastic |= self._outcomes.setdefault(step, outcome) != outcome


def _best_hold(config: Config, generator: EpisodeGenerator) -> tuple[int, Sample]:
    """Return the best number of steps to hold random actions for, and the sample with this number.

    If a single step has little effect, random actions cancel each other, and even the best few
    random episodes obtain no more than the median. Only then are actions held: for the number of
    steps with which the best few episodes obtain most, if all of these exceed the median without
    held actions. Otherwise, and in stochastic environments, whose best episodes may be lucky, 1.
    """
    sample = _play(config, generator, 1)
    ordered = sorted(sample.returns)
    median = ordered[len(ordered) // 2]
    found = {1: sample}
    if ordered[-_N_BEST] <= median and not sample.is_stochastic:
        held = {hold: _play(config, generator, hold) for hold in _HOLDS}
        found |= {hold: one for hold, one in held.items() if one.best()[0] > median}
    best = max(found, key=lambda hold: sum(found[hold].best()))
    return best, found[best]


def _play(config: Config, generator: EpisodeGenerator, hold: int) -> Sample:
    """Run the first commands of the warm-up, with random actions held for ``hold`` steps."""
    sampler = CommandSampler(change(config, n_warm_up_episodes=_MAX_EPISODES), generator.spec)
    sample = Sample()
    for n, command in enumerate(sampler.warm_up()):
        steps = sum(sample.lengths)
        if steps >= (_MAX_STEPS if n < _EPISODES else _STEPS):
            break
        played = msgspec.structs.replace(
            command, random_hold=hold, max_steps=min(command.max_steps, _MAX_LENGTH)
        )
        sample.add(*generate_episodes(generator, [played], None))
    return sample


def rewards_are_rare(sample: Sample, settings: CommandSettings) -> bool:
    """Return whether few random episodes of the usual window would exceed the median.

    A window of at least ``_BEST`` episodes is always large enough; the best episodes of all time
    may only have been lucky. The share of better episodes is estimated by the rule of succession,
    so that a small sample without any does not decide.
    """
    n, steps = len(sample.returns), settings.n_steps_per_iter or 0
    median = sorted(sample.returns)[n // 2]
    share = (1 + sum(value > median for value in sample.returns)) / (n + 2)
    per_iteration = max(settings.n_episodes_per_iter, steps * n / sum(sample.lengths))
    window = _MAX_AGE * per_iteration
    return window < _BEST and share * window < _FEWEST


def scale_fits(scale: float, size: float) -> bool:
    """Return whether a scale turns values of a magnitude into suitable network inputs."""
    return 0.0 in (size, scale) or _MIN_INPUT <= scale * size <= _MAX_INPUT


def _limit(config: Config, generator: EpisodeGenerator) -> int:
    """Return the step limit of sampled episodes, in steps."""
    training = config.max_train_steps or _MAX_LENGTH
    return min(generator.spec.max_episode_steps, training, _MAX_LENGTH)


def _rounded(scale: float) -> float:
    """Return a scale within its allowed range, rounded to two significant digits."""
    allowed = min(max(scale, 1e-6), 1e6)
    return float(f"{allowed:.2g}")
