"""The remaining time as a part of the observation."""

from typing import Any

import numpy as np
import pytest

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.algorithm1 import algorithm1
from udrl.batches import Batches, draw_examples
from udrl.commands import CommandSampler
from udrl.config import Budget, Config, build
from udrl.episode import Episode
from udrl.experience import Experience
from udrl.segments import Segments
from udrl.streams import Purpose, Stream, stream_key


def config(**values: Any) -> Config:
    small = {
        "environment": "CartPole-v1", "observe_time": True, "max_episode_steps": 12,
        "hidden": [8, 8], "n_warm_up_episodes": 10, "batch_size": 16, "n_updates_per_iter": 4,
        "n_episodes_per_iter": 3, "last_few": 2, "baseline": "value",
    }  # fmt: skip
    return build(Config, small | values)


def warm_up(settings: Config) -> list[Episode]:
    generator = EpisodeGenerator(settings, 2)
    commands = CommandSampler(settings, generator.spec).warm_up()
    return generate_episodes(generator, commands, None)


def test_time_left_decreases_from_1_towards_0_at_the_limit() -> None:
    for limit in ({}, {"max_train_steps": 5}):
        for episode in warm_up(config(**limit)):
            left = episode.observations["['time_left']"].ravel()
            assert left.tolist() == [np.float32(1 - t / 12) for t in range(episode.length)]


@pytest.mark.parametrize(
    ("observed", "limit", "bootstraps"),
    [(True, None, False), (True, 5, True), (False, None, True), (False, 5, True)],
)
def test_truncation_bootstraps_unless_the_limit_is_observed(
    observed: bool, limit: int | None, bootstraps: bool
) -> None:
    settings = config(observe_time=observed, max_train_steps=limit)
    episodes = [e for e in warm_up(settings) if e.truncated]
    assert episodes
    experience = Experience(settings, EpisodeGenerator(settings, 1).spec)
    for episode in episodes:
        experience.add(episode)
    ranked = experience.by_rank([e.command_id for e in episodes])
    ranked.label(np.full(int(ranked.lengths.sum()), 100.0, np.float32), 1.0)
    n = ranked.lengths
    last = ranked.examples(Segments(np.arange(len(n)), n - 1, n)).command[:, 0]
    assert (last == (101.0 if bootstraps else 1.0)).all()


def test_run_is_independent_of_the_number_of_environments() -> None:
    settings = config(observe_previous=True, frame_stack=2)
    runs = [algorithm1(settings, Budget(max_env_steps=200), n) for n in (1, 5)]
    assert len({(run.weights_sha256, run.replay_sha256) for run in runs}) == 1


def test_mask_hides_previous_steps_but_not_time_left() -> None:
    settings = config(
        environment="Taxi-v4", action_mask="info", observe_previous=True, previous_dropout=1.0
    )
    episodes = warm_up(settings)
    experience = Experience(settings, EpisodeGenerator(settings, 1).spec)
    for episode in episodes:
        experience.add(episode)
    ranked = experience.by_rank([e.command_id for e in episodes])
    draw = draw_examples(Stream(stream_key(1, Purpose.TRAINING, 1)), ranked, settings)
    for batch in Batches(draw, ranked, settings).gather(hide=True):
        seen = dict(zip([leaf.name for leaf in ranked.leaves], batch.seen, strict=True))
        for name, values in seen.items():
            assert bool(values.any()) == ("previous" not in name), name
