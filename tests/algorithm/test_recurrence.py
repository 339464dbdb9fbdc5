"""Memory: acting and training have equal states, and agents learn to use them."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.algorithm1 import algorithm1
from udrl.batches import Batches, Windows, draw_examples
from udrl.checkpoint import decode_state, encode_optimizer
from udrl.commands import CommandSampler
from udrl.config import Budget, Config, build, refuse_ineffective
from udrl.episode import Episode
from udrl.errors import ConfigError
from udrl.experience import Experience
from udrl.graph import acting_graph
from udrl.inference import ActingFunction
from udrl.policy import Policy
from udrl.rollout import Rollout
from udrl.streams import Purpose, Stream, stream_key
from udrl.training import train, untrained
from udrl.weights import encode_weights
from udrl.whole_buffer import at_all_steps


class Recall(gym.Env[Any, Any]):
    """Shows a bit at the first step, and pays at the last for the action that equals it."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self, steps: int = 5) -> None:
        self.steps = steps

    def _seen(self) -> Any:
        bit = 2.0 * self.bit - 1 if self.t == 0 else 0.0
        return np.array([bit, self.t == self.steps - 1], np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.t, self.bit = 0, int(self.np_random.integers(2))
        return self._seen(), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        over = self.t == self.steps
        return self._seen(), float(over and action == self.bit), over, False, {}


gym.register("Recall-v0", entry_point=lambda **_: Recall(), max_episode_steps=100)


def settings(**values: Any) -> Config:
    small = {
        "environment": "Recall-v0", "memory": "gru", "memory_size": 8, "memory_window": 3,
        "hidden": [16, 16], "batch_size": 60, "n_updates_per_iter": 20, "learning_rate": 1e-2,
        "n_warm_up_episodes": 40, "n_episodes_per_iter": 20, "replay_size": 60, "recent_size": 60,
        "last_few": 10, "return_scale": 1.0, "horizon_scale": 0.2, "eval_every": 200,
        "eval_episodes": 50,
    }  # fmt: skip
    return build(Config, small | values)


def played(config: Config) -> list[Episode]:
    generator = EpisodeGenerator(config, 4)
    commands = CommandSampler(config, generator.spec).warm_up()
    return generate_episodes(generator, commands, None)


@pytest.mark.parametrize("baseline", ["none", "value", "action_value"])
def test_run_is_independent_of_the_number_of_environments(baseline: str) -> None:
    config = settings(baseline=baseline)
    runs = [algorithm1(config, Budget(max_env_steps=500), n) for n in (1, 7)]
    assert len({(run.weights_sha256, run.replay_sha256) for run in runs}) == 1


def test_recall_is_learned_with_a_memory_only() -> None:
    found = {}
    for memory in ("gru", "none"):
        run = algorithm1(settings(memory=memory, baseline="value"), Budget(max_env_steps=4000))
        found[memory] = run.evaluations[max(run.evaluations)].mean
    assert found["gru"] > 0.9
    assert found["none"] < 0.75


def test_acting_and_training_have_equal_states() -> None:
    config = settings(environment="CartPole-v1", baseline="value", max_episode_steps=50)
    episodes = played(config)[:6]
    generator = EpisodeGenerator(config, 1)
    experience = Experience(config, generator.spec)
    for episode in episodes:
        experience.add(episode)
    ranked = experience.by_rank([e.command_id for e in episodes])
    state = untrained(config, generator.spec)
    train(state, ranked, config)
    behavior = state.behavior
    found = at_all_steps(lambda seen, _, before: behavior.encode(seen, before), 8, ranked, config)
    windows = Windows(ranked.lengths, config.training.memory_window)
    function = ActingFunction(acting_graph(config.network, generator.spec), state.weights)
    first = 0
    for rank, episode in enumerate(episodes):
        remembered = np.zeros((1, function.state_size), np.float32)
        for t in range(episode.length):
            if t % windows.size == 0:
                assert found.states is not None
                start = found.states[windows.first[rank] + t // windows.size]
                np.testing.assert_allclose(start.numpy(), remembered[0, :8], atol=1e-5)
            seen = (episode.observations[t : t + 1],)
            _, remembered = function.advance(seen, np.array([[9.0, 9.0]]), remembered)
            np.testing.assert_allclose(found.outputs[first + t], remembered[0, :8], atol=1e-5)
        first += episode.length


def test_windows_cover_every_step_once() -> None:
    lengths = np.array([1, 3, 4, 10])
    windows = Windows(lengths, 3)
    assert windows.counts.tolist() == [1, 1, 2, 4]
    found = []
    for rank in range(4):
        for chunk in range(windows.counts[rank]):
            segments, valid = windows.steps(np.array([rank]), np.array([chunk]))
            assert segments.t1.max() < lengths[rank]
            assert (segments.t2 == lengths[rank]).all()
            found += [(rank, t) for t in segments.t1[valid].tolist()]
    assert found == [(rank, t) for rank, n in enumerate(lengths) for t in range(n)]


def test_batch_consists_of_windows_of_consecutive_steps() -> None:
    config = settings(observe_previous=True, previous_dropout=0.5)
    episodes = played(config)
    generator = EpisodeGenerator(config, 1)
    experience = Experience(config, generator.spec)
    for episode in episodes:
        experience.add(episode)
    ranked = experience.by_rank([e.command_id for e in episodes])
    draw = draw_examples(Stream(stream_key(1, Purpose.TRAINING, 1)), ranked, config)
    assert draw.segments.rank.shape == (20, 60)
    assert draw.windows is not None
    assert draw.windows.shape == (20, 20)
    assert draw.valid is not None
    by_window = draw.segments.t1.reshape(20, 20, 3)
    assert (by_window[..., 0] % 3 == 0).all()
    assert draw.valid.reshape(20, 20, 3)[..., 0].all()
    assert draw.hidden is not None
    hidden = draw.hidden.reshape(20, 20, 3)
    assert (hidden == hidden[..., :1]).all()
    for batch in Batches(draw, ranked, config).gather():
        assert batch.valid is not None
        assert batch.counted(batch.command).shape == (int(batch.valid.sum()), 2)


def test_training_resumes_with_identical_results() -> None:
    config = settings(baseline="action_value", normalise_observations=True)
    episodes = played(config)
    spec = EpisodeGenerator(config, 1).spec

    def advance(state: Any) -> Any:
        experience = Experience(config, spec)
        for episode in episodes:
            experience.add(episode)
        train(state, experience.by_rank([e.command_id for e in episodes]), config)
        return state

    straight = advance(advance(untrained(config, spec)))
    first = advance(untrained(config, spec))
    weights, optimizer = encode_weights(first.weights), encode_optimizer(first)
    resumed = advance(decode_state(1, weights, optimizer, config, spec))
    assert encode_weights(resumed.weights) == encode_weights(straight.weights)
    assert encode_optimizer(resumed) == encode_optimizer(straight)


def test_policy_keeps_its_state_until_reset_and_rollout_has_its_own() -> None:
    config = settings()
    generator = EpisodeGenerator(config, 1)
    graph = acting_graph(config.network, generator.spec)
    run = algorithm1(config, Budget(max_env_steps=400))
    function = ActingFunction(graph, run.state.weights)
    sampler = CommandSampler(config, generator.spec)
    command = sampler.evaluate(run.iteration, run.buffer)[0]
    (episode,) = generate_episodes(generator, [command], function)
    policy = Policy(function, config, generator.spec, np.random.default_rng(1))
    env = policy.make_environment()
    rollout = Rollout(policy, env, command)
    actions = []
    while not rollout.over:
        assert rollout.probabilities.tolist() == rollout.probabilities.tolist()
        rollout.step()
        actions.append(rollout.action)
    assert actions == episode.actions.tolist()

    first, _ = env.reset(seed=1)
    logits = policy.logits(first, 1.0, 5).tolist()
    assert policy.logits(first, 1.0, 5).tolist() == logits
    policy.predict(first, 1.0, 5)
    assert policy.logits(first, 1.0, 5).tolist() != logits
    policy.reset()
    assert policy.logits(first, 1.0, 5).tolist() == logits


def test_all_segments_have_no_windows() -> None:
    with pytest.raises(ConfigError, match="segments = 'all' with memory = 'gru'"):
        settings(segments="all")
    for name in ("memory_size", "memory_window"):
        with pytest.raises(ConfigError, match=f"{name} = .* has no effect"):
            refuse_ineffective(settings(memory="none"), [name])
