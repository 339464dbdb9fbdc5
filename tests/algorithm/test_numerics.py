from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from torch import Tensor

from udrl.acting import EpisodeGenerator
from udrl.actions import Categorical
from udrl.behavior import BehaviorFunction
from udrl.config import Config, build
from udrl.determinism import environment_digest, repeated_digest
from udrl.environments import Environment, EnvironmentSpec
from udrl.environments.making import adapt
from udrl.environments.obedience import Obedience
from udrl.errors import EnvironmentFault
from udrl.graph import acting_graph
from udrl.inference import ActingFunction
from udrl.numerics import acting_class
from udrl.spaces import Vector
from udrl.training_class import training_class

LANDER = EnvironmentSpec(
    observation_space=Vector(size=8), action_space=Categorical(n=4), max_episode_steps=1000
)


def settings(environment: str = "CartPole-v1", **values: Any) -> Config:
    small = {"environment": environment, "hidden": [16, 16], "batch_size": 32}
    return build(Config, small | values)


@pytest.mark.parametrize("name", ["CartPole-v1", "Figure2-v0", "LunarLander-v3", "Obedience-v0"])
def test_environments_of_the_paper_and_the_toys_replay(name: str) -> None:
    config = settings(name)
    assert repeated_digest(EpisodeGenerator(config, 1))


class Drifting(Obedience):
    """Its observation depends on the number of resets."""

    resets = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        self.resets += 1
        return super().reset(seed=seed)

    def _observe(self) -> Any:
        return super()._observe() / np.float32(self.resets)


class Failing(Obedience):
    """Raises at every step."""

    def step(self, action: Any) -> Any:
        raise RuntimeError("out of order")


def generator_of(env: Callable[..., Environment]) -> EpisodeGenerator:
    spec = EnvSpec("Made-v0", entry_point=env, max_episode_steps=16)

    def make(config: Config) -> Environment:
        return adapt(gym.make(spec, disable_env_checker=True), "Made-v0", config.actions)

    return EpisodeGenerator(settings(), 2, make)


def test_environment_with_memory_of_earlier_episodes_does_not_replay() -> None:
    assert repeated_digest(generator_of(Obedience))
    assert not repeated_digest(generator_of(Drifting))


def test_environment_that_fails_the_probe_is_reported() -> None:
    with pytest.raises(EnvironmentFault, match="out of order"):
        repeated_digest(generator_of(Failing))


def class_of(config: Config) -> str:
    return acting_class(acting_graph(config.network, LANDER), LANDER.action_space)


def test_environment_digest_is_independent_of_the_number_of_environments() -> None:
    config = settings()
    digests = {environment_digest(EpisodeGenerator(config, n)) for n in (1, 3, 20)}
    assert len(digests) == 1
    assert digests != {environment_digest(generator_of(Obedience))}


def test_probes_leave_the_generator_unchanged() -> None:
    generator = EpisodeGenerator(settings(), 2)
    first = environment_digest(generator)
    assert repeated_digest(generator) == environment_digest(generator) == first
    assert generator.free == 2


def test_acting_class_depends_on_the_last_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    config = settings()
    expected = class_of(config)
    advance = ActingFunction.advance

    def round_differently(self: ActingFunction, *rows: Any) -> Any:
        logits, state = advance(self, *rows)
        return np.nextafter(logits, np.float32(np.inf)), state

    monkeypatch.setattr(ActingFunction, "advance", round_differently)
    assert class_of(config) != expected


def test_training_class_depends_on_the_last_bit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = settings()
    expected = training_class(config, LANDER)
    assert training_class(config, LANDER) == expected
    forward_relative = BehaviorFunction.forward_relative

    def round_differently(self: BehaviorFunction, *inputs: Any) -> Tensor:
        return forward_relative(self, *inputs) * (1 + 2**-23)

    monkeypatch.setattr(BehaviorFunction, "forward_relative", round_differently)
    assert training_class(config, LANDER) != expected


@pytest.mark.parametrize("segments", ["trailing", "all"])
def test_training_class_is_independent_of_the_size_of_the_run(segments: str) -> None:
    small = settings(segments=segments, n_updates_per_iter=1, replay_size=1, last_few=1)
    large = settings(segments=segments, n_updates_per_iter=500, replay_size=700, last_few=75)
    assert training_class(small, LANDER) == training_class(large, LANDER)
