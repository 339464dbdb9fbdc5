from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from torch import Tensor

from udrl import numerics
from udrl.acting import EpisodeGenerator
from udrl.behavior import Acting, BehaviorFunction, initialise
from udrl.config import Config, build
from udrl.environments import Environment, EnvironmentSpec
from udrl.environments.obedience import Obedience
from udrl.errors import EnvironmentFault, InexactArithmetic
from udrl.numerics import (
    STRICT_MKL,
    acting_class,
    check_batch_invariance,
    environment_replays,
    training_class,
    use_one_thread,
)

LANDER = EnvironmentSpec(observation_shape=(8,), n_actions=4, max_episode_steps=1000)


def settings(environment: str = "CartPole-v1", **values: Any) -> Config:
    small = {"environment": environment, "hidden": [16, 16], "batch_size": 32}
    return build(Config, small | values)


@pytest.mark.parametrize("hidden", [[32, 128, 128, 128], [64, 128, 128], [32]])
def test_rows_keep_their_bits_in_any_company_here(hidden: list[int]) -> None:
    check_batch_invariance(settings(hidden=hidden), LANDER)


class SeesNeighbours(BehaviorFunction):
    """A row's logits depend, ever so slightly, on the other rows."""

    def frozen(self) -> Acting:
        act = super().frozen()
        return lambda observation, command: act(observation, command) + 1e-5 * observation.std()


class SeesOneNeighbour(BehaviorFunction):
    """Only the row below makes a difference."""

    def frozen(self) -> Acting:
        act = super().frozen()
        return lambda observation, command: act(
            observation + 1e-3 * observation.roll(1, dims=0), command
        )


class SeesItsPlace(BehaviorFunction):
    """A row's logits depend on where it stands, as the blocks of a matrix product might."""

    def frozen(self) -> Acting:
        act = super().frozen()

        def last_differs(observation: Tensor, command: Tensor) -> Tensor:
            logits = act(observation, command)
            logits[-1] += 1e-6
            return logits

        return last_differs


@pytest.mark.parametrize("kind", [SeesNeighbours, SeesOneNeighbour, SeesItsPlace])
def test_a_row_that_depends_on_company_or_place_is_refused_with_the_remedy(
    kind: type[BehaviorFunction], monkeypatch: pytest.MonkeyPatch
) -> None:
    def doctored(config: Config, spec: EnvironmentSpec) -> BehaviorFunction:
        behavior = kind(spec, config)
        behavior.load_state_dict(initialise(config, spec).state_dict())
        return behavior

    monkeypatch.setattr(numerics, "initialise", doctored)
    with pytest.raises(InexactArithmetic, match=r"other 15 rows.*MKL_CBWR=AVX2,STRICT"):
        check_batch_invariance(settings(), LANDER)


def test_strict_mode_is_an_environment_variable() -> None:
    assert STRICT_MKL == {"MKL_CBWR": "AVX2,STRICT"}


def test_every_role_computes_in_one_thread_and_deterministically() -> None:
    use_one_thread()
    assert torch.get_num_threads() == 1
    assert torch.are_deterministic_algorithms_enabled()


@pytest.mark.parametrize("name", ["CartPole-v1", "Figure2-v0", "LunarLander-v3", "Obedience-v0"])
def test_environments_of_the_paper_and_the_toys_replay(name: str) -> None:
    config = settings(name)
    assert environment_replays(config, EpisodeGenerator(config, 1))


class Drifting(Obedience):
    """Remembers, in its observation, how often it was reset."""

    resets = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        self.resets += 1
        return super().reset(seed=seed)

    def _observe(self) -> Any:
        return super()._observe() / np.float32(self.resets)


class Failing(Obedience):
    """Cannot be stepped."""

    def step(self, action: Any) -> Any:
        raise RuntimeError("out of order")


def generator_of(env: Callable[..., Environment]) -> tuple[Config, EpisodeGenerator]:
    spec = EnvSpec("Made-v0", entry_point=env, max_episode_steps=16)
    config = settings()
    return config, EpisodeGenerator(config, 2, lambda _: gym.make(spec, disable_env_checker=True))


def test_an_environment_that_remembers_other_episodes_does_not_replay() -> None:
    assert environment_replays(*generator_of(Obedience))
    assert not environment_replays(*generator_of(Drifting))


def test_an_environment_that_fails_the_probe_is_at_fault() -> None:
    with pytest.raises(EnvironmentFault, match="out of order"):
        environment_replays(*generator_of(Failing))


def test_the_acting_class_does_not_depend_on_the_number_of_environments() -> None:
    config = settings()
    classes = {acting_class(config, EpisodeGenerator(config, n)) for n in (1, 3, 20)}
    assert len(classes) == 1


def test_a_generator_is_as_good_as_new_after_the_probes() -> None:
    config = settings()
    generator = EpisodeGenerator(config, 2)
    first = acting_class(config, generator)
    environment_replays(config, generator)
    assert acting_class(config, generator) == first
    assert generator.free == 2


def test_the_acting_class_sees_a_change_of_the_last_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    config = settings()
    expected = acting_class(config, EpisodeGenerator(config, 1))
    frozen = BehaviorFunction.frozen

    def rounds_otherwise(self: BehaviorFunction) -> Acting:
        def act(s: Tensor, c: Tensor) -> Tensor:
            logits = frozen(self)(s, c)
            return torch.nextafter(logits, torch.full_like(logits, torch.inf))

        return act

    monkeypatch.setattr(BehaviorFunction, "frozen", rounds_otherwise)
    assert acting_class(config, EpisodeGenerator(config, 1)) != expected


def test_the_training_class_sees_a_change_of_the_last_bit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = settings()
    expected = training_class(config, LANDER)
    assert training_class(config, LANDER) == expected
    forward = BehaviorFunction.forward

    def rounds_otherwise(self: BehaviorFunction, s: Tensor, c: Tensor) -> Tensor:
        return forward(self, s, c) * (1 + 2**-23)

    monkeypatch.setattr(BehaviorFunction, "forward", rounds_otherwise)
    assert training_class(config, LANDER) != expected


@pytest.mark.parametrize("segments", ["trailing", "all"])
def test_the_training_class_does_not_depend_on_the_size_of_the_run(segments: str) -> None:
    small = settings(segments=segments, n_updates_per_iter=1, replay_size=1, last_few=1)
    large = settings(segments=segments, n_updates_per_iter=500, replay_size=700, last_few=75)
    assert training_class(small, LANDER) == training_class(large, LANDER)
