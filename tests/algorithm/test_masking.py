"""Masked actions are never taken."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.actions import Categorical, Product, random_actions
from udrl.algorithm1 import algorithm1
from udrl.automatic_settings import with_offered_mask
from udrl.commands import CommandSampler
from udrl.config import Budget, Config, build
from udrl.environments import make_environment
from udrl.environments.specification import specify
from udrl.episode import Episode, fault
from udrl.errors import EnvironmentFault, UnsupportedEnvironment
from udrl.graph import acting_graph
from udrl.inference import ActingFunction
from udrl.policy import Policy
from udrl.rollout import Rollout
from udrl.spaces import leaves_of


class Doors(gym.Env[Any, Any]):
    """Some doors are open. A closed one raises an error, and the last one pays most."""

    def __init__(self, *, shows: str = "", two: bool = False, fault: str = "") -> None:
        self.shows, self.two, self.fault = shows, two, fault
        self.action_space = spaces.MultiDiscrete([4, 2]) if two else spaces.Discrete(4)
        seen = spaces.Box(0, 1, (1,), np.float32)
        self.observation_space: spaces.Space[Any] = seen
        if shows:
            self.observation_space = spaces.Dict(
                {shows: spaces.Box(0, 1, (6 if two else 4,)), "time": seen}
            )

    def _returned(self) -> tuple[Any, dict[str, Any]]:
        self.open = self.np_random.integers(0, 2, 4, np.int8)
        self.open[self.np_random.integers(4)] = 1
        mask: Any = self.open
        if self.two:
            mask = (self.open, np.array([0, 1], np.int8))
        time = np.array([self.t / 6], np.float32)
        if self.fault == "none open" or (self.fault == "none open at last" and self.t == 6):
            mask = np.zeros(4, np.int8)
        if self.fault == "second closed":
            mask = (self.open, np.zeros(2, np.int8))
        if self.fault == "half open":
            mask = np.array([1.0, 0.0, 1.0, 0.5], np.float32)
        if self.fault == "wide open":
            mask = np.array([256, 1, 2, 1])
        if self.fault == "too short":
            mask = np.ones(3, np.int8)
        if self.fault == "ragged":
            mask = [1, 0, [1, 1], 0]
        absent = self.fault == "no mask" or (self.fault == "only at reset" and self.t > 0)
        info = {} if absent else {"action_mask": mask}
        flat = np.concatenate(mask) if self.two else mask
        return ({self.shows: flat, "time": time} if self.shows else time), info

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        return self._returned()

    def step(self, action: Any) -> Any:
        door, second = action if self.two else (action, 1)
        assert self.open[door], "closed door"
        assert second == 1
        self.t += 1
        observation, info = self._returned()
        return observation, float(door), self.t == 6, False, info


gym.register("Doors-v0", entry_point=lambda **k: Doors(**k), max_episode_steps=20)


def config(mask: str | None = "info", given: dict[str, Any] | None = None, **values: Any) -> Config:
    small = {
        "environment": "Doors-v0", "environment_kwargs": given or {}, "action_mask": mask,
        "hidden": [8, 8], "batch_size": 32, "n_updates_per_iter": 10, "n_warm_up_episodes": 20,
        "n_episodes_per_iter": 5, "last_few": 5, "eval_every": 100, "eval_episodes": 5,
        "hold_share": 0.5, "hold_rate": 0.3, "hold_steps": 2,
    }  # fmt: skip
    return build(Config, small | values)


@pytest.mark.parametrize(
    ("mask", "given", "values"),
    [
        ("info", {}, {}),
        ("info", {"two": True}, {"observe_previous": True, "frame_stack": 2}),
        ("doors", {"shows": "doors"}, {"eval_temperature": 0.0}),
        ("doors", {"shows": "doors", "two": True}, {"observe_previous": True, "memory": "gru"}),
        ("doors", {"shows": "doors"}, {"baseline": "action_value", "normalise_observations": True}),
    ],
)
def test_run_takes_allowed_actions_only(
    mask: str, given: dict[str, Any], values: dict[str, Any]
) -> None:
    settings = config(mask, given, **values)
    runs = [algorithm1(settings, Budget(max_env_steps=400), n) for n in (1, 5)]
    assert len({(run.weights_sha256, run.replay_sha256) for run in runs}) == 1
    assert np.isfinite(runs[0].state.loss)


@pytest.mark.parametrize(
    ("given", "chosen"),
    [
        ({}, "info"),
        ({"two": True}, "info"),
        ({"fault": "no mask"}, None),
        ({"fault": "too short"}, None),
        ({"fault": "only at reset"}, None),
        ({"fault": "none open"}, None),
        ({"fault": "half open"}, None),
        ({"shows": "action_mask"}, "action_mask"),
        ({"shows": "action_mask", "two": True, "fault": "no mask"}, "action_mask"),
        ({"shows": "action_mask", "fault": "half open"}, None),
        ({"shows": "doors", "fault": "no mask"}, None),
    ],
)
def test_automatic_mask_is_the_one_that_the_environment_offers(
    given: dict[str, Any], chosen: str | None
) -> None:
    settings = config(None, given)
    assert with_offered_mask(settings, ["action_mask"]).actions.action_mask == chosen
    assert with_offered_mask(settings, ["hold_rate"]) == settings


@pytest.mark.parametrize(
    ("mask", "path"), [("info", ("action_mask",)), ("action_mask", ("observation", "action_mask"))]
)
def test_mask_is_the_one_that_is_asked_for(mask: str, path: tuple[str, ...]) -> None:
    settings = config(mask, {"shows": "action_mask"}, observe_time=True)
    spec = specify(make_environment(settings), settings)
    assert spec.action_mask is not None
    assert leaves_of(spec.observation_space)[spec.action_mask].path == path


def test_run_with_an_automatic_mask_takes_allowed_actions_only() -> None:
    automatic = ["action_mask", "observe_time", "return_scale"]
    run = algorithm1(config(None), Budget(max_env_steps=400), automatic=automatic)
    assert np.isfinite(run.state.loss)


def test_random_action_is_uniform_among_the_allowed() -> None:
    space, mask = Categorical(n=4), np.array([[0, 1, 0, 1]], np.uint8).repeat(1000, axis=0)
    found = random_actions(space, mask, np.linspace(0, 1, 1000, endpoint=False))
    assert found.tolist() == [1] * 500 + [3] * 500
    pairs, both = Product(ns=(2, 3)), np.array([[1, 0, 0, 1, 1]], np.uint8).repeat(8, axis=0)
    drawn = random_actions(pairs, both, np.random.default_rng(1).random((8, 2)))
    assert drawn[:, 0].tolist() == [0] * 8
    assert set(drawn[:, 1].tolist()) == {1, 2}
    assert pairs.allowed(both, drawn).all()
    assert pairs.allowed(both[:1], np.array([[1, 0]])).tolist() == [[False, False]]


def test_rollout_takes_allowed_actions_only() -> None:
    settings = config("info", {"two": True})
    run = algorithm1(settings, Budget(max_env_steps=300))
    generator = EpisodeGenerator(settings, 2)
    function = ActingFunction(acting_graph(settings.network, generator.spec), run.state.weights)
    sampler = CommandSampler(settings, generator.spec)
    policy = Policy(function, settings, generator.spec)
    for command in [*sampler.explore(9, run.buffer), *sampler.warm_up()[:3]]:
        (episode,) = generate_episodes(generator, [command], function)
        rollout = Rollout(policy, make_environment(settings), command)
        actions = []
        while not rollout.over:
            rollout.step()
            actions.append(rollout.action)
        assert actions == episode.actions.tolist()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"fault": "no mask"}, "a dict of nothing as info, without 'action_mask'"),
        (
            {"fault": "too short"},
            r"an array of int8, shape \(3,\) as info\['action_mask'\], expected 4",
        ),
        ({"fault": "ragged"}, r"a list .* as info\['action_mask'\], expected 4"),
    ],
)
def test_invalid_mask_is_an_error_of_the_environment(given: dict[str, Any], message: str) -> None:
    generator = EpisodeGenerator(config("info", given), 1)
    commands = CommandSampler(config(), generator.spec).warm_up()
    with pytest.raises(EnvironmentFault, match=message):
        generate_episodes(generator, commands, None)


def test_ragged_mask_entry_is_a_fault_of_the_observation() -> None:
    env = make_environment(config("doors", {"fault": "ragged", "shows": "doors"}))
    with pytest.raises(EnvironmentFault, match=r"reset\(\) returned.*'doors'"):
        env.reset(seed=1)


@pytest.mark.parametrize("previous", [False, True])
@pytest.mark.parametrize(("mask", "shows"), [("info", ""), ("doors", "doors")])
@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("half open", r"0\.5 as number 3 of MASK, expected 0 or 1"),
        ("wide open", r"256\b.* as number 0 of MASK, expected 0 or 1"),
        ("none open", r"no 1 in MASK, so no action is allowed; expected at least one"),
        ("second closed", r"no 1 in the numbers 4 to 5 of MASK, so no action is allowed"),
    ],
)
def test_mask_has_zeros_and_ones_and_allows_an_action(
    fault: str, message: str, mask: str, shows: str, previous: bool
) -> None:
    given = {"fault": fault, "shows": shows, "two": fault == "second closed"}
    name = r"info\['action_mask'\]" if mask == "info" else r"observation\['doors'\]"
    env = make_environment(config(mask, given, observe_previous=previous))
    with pytest.raises(
        EnvironmentFault, match=r"reset\(\) returned " + message.replace("MASK", name)
    ):
        env.reset(seed=1)


@pytest.mark.parametrize(("mask", "shows"), [("info", ""), ("doors", "doors")])
def test_mask_after_the_last_step_may_allow_no_action(mask: str, shows: str) -> None:
    settings = config(mask, {"fault": "none open at last", "shows": shows})
    generator = EpisodeGenerator(settings, 1)
    commands = CommandSampler(settings, generator.spec).warm_up()[:2]
    assert [e.length for e in generate_episodes(generator, commands, None)] == [6, 6]


@pytest.mark.parametrize(
    ("mask", "given", "message"),
    [
        (
            "walls",
            {"shows": "doors"},
            "has no such entry; expected 'info', or one of 'doors', 'time'",
        ),
        ("walls", {}, "has no such entry; expected 'info'$"),
        ("time", {"shows": "doors"}, r"it is Vector\(size=1\), expected 4 numbers, 0 or 1"),
    ],
)
def test_invalid_mask_entry_is_rejected(mask: str, given: dict[str, Any], message: str) -> None:
    with pytest.raises(UnsupportedEnvironment, match=message):
        EpisodeGenerator(config(mask, given), 1)


def test_episode_with_a_masked_action_is_rejected() -> None:
    settings = config()
    generator = EpisodeGenerator(settings, 1)
    commands = CommandSampler(settings, generator.spec).warm_up()[:1]
    (episode,) = generate_episodes(generator, commands, None)
    assert fault(episode, generator.spec) is None
    mask = episode.observations["['action_mask']"]
    forbidden = episode.actions.copy()
    step = next(t for t in range(episode.length) if not mask[t].all())
    forbidden[step] = mask[step].argmin()
    spoiled = Episode(
        0, episode.observations, forbidden, episode.rewards, episode.terminated, episode.truncated
    )
    assert fault(spoiled, generator.spec) == "an action was taken that action_mask does not allow"
