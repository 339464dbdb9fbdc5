"""``udrl check``: whether an environment is supported, and its properties."""

import logging
import re
import resource
import sys
import time
import warnings
from collections.abc import Collection
from contextlib import closing
from typing import Any

import msgspec
import numpy as np
from gymnasium.utils.env_checker import check_env

from udrl.acting import EpisodeGenerator
from udrl.automatic_settings import choose, scale_fits, with_offered_mask
from udrl.commands import CommandSampler, strategy_of
from udrl.config import Config, change, flat, preset, preset_names
from udrl.cost import slow_training_warning
from udrl.determinism import environment_digest, repeated_digest
from udrl.environments.making import make_environment
from udrl.episode import Episode
from udrl.spaces import Image, ObservationSpace, leaves_of, parts_of

#: Number of random episodes, and seconds after which no further one is started.
_EPISODES = 20
_PATIENCE_S = 20.0
_MIB = 2**20
#: Images whose values never exceed this, of 255, may hold indices.
_DARK = 31


class Check(msgspec.Struct, frozen=True, kw_only=True):
    """Properties of an environment.

    Attributes:
        environment: its id.
        declared_observations: its observation space.
        declared_actions: its action space.
        observations: the observation space as the algorithm reads it.
        actions: the action space as the algorithm reads it.
        max_episode_steps: its step limit.
        max_return: the declared highest possible return. None: none is declared.
        repeats: whether an episode can be repeated from its seed, in the same instance and in
            another. Only then are runs exact.
        episodes: number of random episodes.
        return_min, return_mean, return_max: their returns.
        length_mean: their mean length in steps.
        make_s: seconds to create an environment.
        reset_s: mean seconds of a reset.
        step_s: mean seconds of a step.
        memory_mib: approximate memory of an environment in this process; 0 if it is too small to
            measure.
        step_bytes: size of one step as it is sent and stored.
        chosen: values of the settings that are chosen automatically.
        advice: a sentence about each unusual property.
    """

    environment: str
    declared_observations: str
    declared_actions: str
    observations: str
    actions: str
    max_episode_steps: int
    max_return: float | None
    repeats: bool
    episodes: int
    return_min: float
    return_mean: float
    return_max: float
    length_mean: float
    make_s: float
    reset_s: float
    step_s: float
    memory_mib: float
    step_bytes: int
    chosen: dict[str, float | str | None]
    advice: tuple[str, ...]


def check_environment(config: Config, automatic: Collection[str] = ()) -> Check:
    """Create an environment, check it, and play random episodes.

    Args:
        config: the settings of a run.
        automatic: settings to choose automatically (:mod:`udrl.automatic_settings`).

    Raises:
        ConfigError: the command strategy cannot be created.
        UnsupportedEnvironment: it cannot be created or is not supported.
        EnvironmentFault: it raised an exception, or returned an invalid value.
    """
    before, began = _memory(), time.perf_counter()
    env = make_environment(config)
    make_s = time.perf_counter() - began
    memory = _memory() - before
    advice = _gymnasium_findings(env.unwrapped)
    env.close()
    config = with_offered_mask(config, automatic)
    with closing(EpisodeGenerator(config, 1)) as generator:
        fitted = choose(config, automatic, generator) if automatic else config
    env = make_environment(fitted)  # what is chosen may add to the observations
    declared = env.observations.declared, env.actions.declared
    env.close()
    with closing(EpisodeGenerator(fitted, 1)) as generator:
        spec = generator.spec
        strategy_of(fitted, spec)  # raises if it cannot be created
        digest = repeated_digest(generator)
        episodes, reset_s, step_s = _play(generator, fitted)
    with closing(EpisodeGenerator(fitted, 1)) as another:
        repeats = environment_digest(another) == digest
    returns = [e.episode_return for e in episodes]
    advice += _unusual(fitted, episodes, repeats=repeats)
    advice += _index_images(spec.observation_space, episodes)
    if long := slow_training_warning(fitted, spec):
        advice.append(f"{long[0].upper()}{long[1:]}.")
    return Check(
        environment=config.environment,
        declared_observations=str(declared[0]),
        declared_actions=str(declared[1]),
        observations=str(spec.observation_space),
        actions=str(spec.action_space),
        max_episode_steps=spec.max_episode_steps,
        max_return=spec.max_return,
        repeats=repeats,
        episodes=len(episodes),
        return_min=min(returns),
        return_mean=sum(returns) / len(returns),
        return_max=max(returns),
        length_mean=sum(e.length for e in episodes) / len(episodes),
        make_s=make_s,
        reset_s=reset_s,
        step_s=step_s,
        memory_mib=round(max(0.0, memory) / _MIB, 1),
        step_bytes=spec.step_bytes,
        chosen={name: flat(fitted)[name] for name in sorted(automatic)},
        advice=tuple(advice),
    )


def _play(generator: EpisodeGenerator, config: Config) -> tuple[list[Episode], float, float]:
    """Play random episodes; return them and the mean seconds of a reset and a step."""
    sampler = CommandSampler(change(config, n_warm_up_episodes=_EPISODES), generator.spec)
    episodes: list[Episode] = []
    resets = steps = 0.0
    began = time.perf_counter()
    for command in sampler.warm_up():
        at = time.perf_counter()
        failure = generator.start(command, None)
        resets += time.perf_counter() - at
        if failure is not None:
            raise failure.error
        at = time.perf_counter()
        while not (ended := generator.step()):
            pass
        steps += time.perf_counter() - at
        for outcome in ended:
            if not isinstance(outcome, Episode):
                raise outcome.error
            episodes.append(outcome)
        if time.perf_counter() - began > _PATIENCE_S:
            break
    return episodes, resets / len(episodes), steps / sum(e.length for e in episodes)


def _gymnasium_findings(env: Any) -> list[str]:
    """Return a sentence for each finding of Gymnasium's own checker."""
    logger = logging.getLogger("gymnasium")
    level = logger.level
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        try:
            check_env(env, skip_render_check=True)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - it raises many types, and runs foreign code
            return [f"Gymnasium's checker reports: {_line(error)}"]
        finally:
            logger.setLevel(level)
    lines = [_line(w.message) for w in found]
    # Most environments have infinite bounds.
    return [f"Gymnasium's checker warns: {text}" for text in lines if "infinity" not in text]


def _line(message: object) -> str:
    """Return a message on one line, without colours."""
    return " ".join(re.sub(r"\x1b\[\d*m|WARN: ", "", str(message)).split())


def _unusual(config: Config, episodes: list[Episode], *, repeats: bool) -> list[str]:
    """Return a sentence for each unusual property of random episodes, with its remedy."""
    advice = []
    returns = np.array([e.episode_return for e in episodes])
    lengths = np.array([e.length for e in episodes])
    if not repeats:
        advice.append(
            "Episodes cannot be repeated from their seeds, so runs are marked exact: false; draw "
            "all random numbers from self.np_random, seeded in reset(seed=...)."
        )
    if np.ptp(returns) == 0:
        advice.append(
            f"All random episodes return {returns[0]:g}, so there is nothing to learn from until "
            f"one of them finds a reward by chance; raise n_warm_up_episodes, hold random actions "
            f"longer (warm_up_hold_steps), or shape the reward."
        )
    if all(e.truncated and not e.terminated for e in episodes):
        advice.append(
            f"All random episodes reach the limit of {lengths[0]} steps. A lower max_train_steps "
            f"shortens episodes in training, but not in evaluations."
        )
    environment = config.environment
    tuned = preset(environment) if environment in preset_names() else {}
    for name, scale, size in (
        ("return_scale", config.network.return_scale, float(np.abs(returns).max())),
        ("horizon_scale", config.network.horizon_scale, float(lengths.mean())),
    ):
        if scale != tuned.get(name) and not scale_fits(scale, size):
            advice.append(
                f"{name} = {scale:g} scales values of about {size:.3g} to inputs of about "
                f"{scale * size:.2g}; the network needs inputs of about 1; try {name} = auto."
            )
    return advice


def _index_images(space: ObservationSpace, episodes: list[Episode]) -> list[str]:
    """Return a sentence for each image that seems to hold indices, with its remedy."""
    advice = []
    for k, leaf in enumerate(leaves_of(space)):
        if not isinstance(leaf.space, Image):
            continue
        most = max(int(parts_of(e.observations)[k].max()) for e in episodes)
        if most <= _DARK:
            advice.append(
                f"The image observation{leaf.name} never exceeds {most} of 255. If it holds "
                f"indices instead of brightness, as in MiniGrid, read it as numbers: --set "
                f"'wrappers=[\"gymnasium.wrappers:FlattenObservation\"]' --set "
                f"normalise_observations=true."
            )
    return advice


def _memory() -> int:
    """Return the peak memory of this process in bytes."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
