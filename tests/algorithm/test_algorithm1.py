from functools import cache
from typing import Any

import pytest

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.algorithm1 import Run, algorithm1
from udrl.commands import CommandSampler
from udrl.config import Budget, Config, build
from udrl.environments.obedience import Obedience
from udrl.episode import Episode
from udrl.errors import ConfigError
from udrl.evaluation import summarise
from udrl.experience import Experience
from udrl.graph import acting_graph
from udrl.inference import ActingFunction
from udrl.replay_buffer import Entry, ReplayBuffer
from udrl.training import train, untrained

BUDGET = Budget(max_env_steps=400)


def settings(**values: Any) -> Config:
    small = {
        "environment": "CartPole-v1",
        "lead": 0,
        "hidden": [16, 16],
        "batch_size": 32,
        "n_updates_per_iter": 5,
        "n_warm_up_episodes": 4,
        "n_episodes_per_iter": 3,
        "replay_size": 6,
        "last_few": 3,
        "eval_every": 150,
        "eval_episodes": 2,
    }
    return build(Config, small | values)


def obedience(**values: Any) -> Config:
    """Episodes of 8 steps: 32 in the warm-up, 24 in every iteration."""
    return settings(environment="Obedience-v0", **values)


def history(
    config: Config, budget: Budget = BUDGET, n_environments: int = 4
) -> list[tuple[Any, ...]]:
    """The state of a run after every iteration."""
    rows: list[tuple[Any, ...]] = []

    def report(run: Run) -> None:
        rows.append(
            (
                run.iteration,
                run.env_steps,
                run.weights_sha256,
                run.replay_sha256,
                run.evaluations.get(run.iteration),
            )
        )

    algorithm1(config, budget, n_environments, report)
    return rows


@cache
def default_history() -> list[tuple[Any, ...]]:
    return history(settings())


@pytest.mark.parametrize("n_environments", [1, 3, 20])
def test_run_is_independent_of_the_number_of_environments(n_environments: int) -> None:
    assert history(settings(), n_environments=n_environments) == default_history()


def test_run_is_repeatable() -> None:
    assert history(settings()) == default_history()


def test_another_seed_changes_the_first_iteration() -> None:
    other = history(settings(seed=2))
    assert other[0][2] != default_history()[0][2]
    assert other[0][3] != default_history()[0][3]


def test_larger_budget_extends_a_smaller_run() -> None:
    longer = history(settings(), Budget(max_env_steps=600))
    assert len(longer) > len(default_history())
    assert longer[: len(default_history())] == default_history()


@pytest.mark.parametrize("recent_size", [0, 8])
def test_run_equals_the_papers_pseudo_code(recent_size: int) -> None:
    config = settings(recent_size=recent_size)

    def held(seen: list[Episode]) -> list[Episode]:
        """The best of all episodes seen so far, ties ranked by age, and the newest."""
        best = sorted(seen, key=lambda e: (e.episode_return, e.command_id))[
            -config.buffer.replay_size :
        ]
        newest = seen[len(seen) - min(recent_size, len(seen)) :]
        return sorted({*best, *newest}, key=lambda e: (e.episode_return, e.command_id))

    generator = EpisodeGenerator(config, n_environments=1)
    sample = CommandSampler(config, generator.spec)
    # 1, 2: warm-up episodes; a behavior function
    seen = generate_episodes(generator, sample.warm_up(), None)
    env_steps, evaluations = sum(e.length for e in seen), {}
    state = untrained(config, generator.spec)
    iteration, crossed = 0, env_steps // config.evaluation.eval_every > 0
    while env_steps < BUDGET.max_env_steps:  # 3
        iteration += 1
        known = held(seen)
        entries = [Entry(e.episode_return, e.command_id, e.length) for e in known]
        buffer = ReplayBuffer(config.buffer, entries)
        experience = Experience(config, generator.spec)
        for episode in known:
            experience.add(episode)
        train(state, experience.by_rank([e.command_id for e in known]), config)  # 4
        act = ActingFunction(acting_graph(config.network, generator.spec), state.weights)
        exploratory = sample.explore(iteration, buffer)  # 5
        new = generate_episodes(generator, exploratory, act)  # 6
        seen += new
        if crossed:  # 7, 8
            evaluated = generate_episodes(generator, sample.evaluate(iteration, buffer), act)
            evaluations[iteration] = summarise([e.episode_return for e in evaluated])
        before, env_steps = env_steps, env_steps + sum(e.length for e in new)
        crossed = env_steps // config.evaluation.eval_every > before // config.evaluation.eval_every

    run = algorithm1(config, BUDGET, 4)
    known = held(seen)
    assert (run.iteration, run.env_steps) == (iteration, env_steps)
    assert run.evaluations == evaluations
    assert evaluations
    assert [entry.id for entry in run.buffer] == [e.command_id for e in known]
    assert run.experience.ids() == {e.command_id for e in known}
    assert set(run.digests) == {e.command_id for e in known}
    ours, theirs = state.behavior.state_dict(), run.state.behavior.state_dict()
    assert all(bool((ours[name] == theirs[name]).all()) for name in ours)


def test_warm_up_of_obedience_is_pinned() -> None:
    # Without a network, the result does not depend on the platform's arithmetic.
    run = algorithm1(obedience(), Budget(max_env_steps=1))
    assert run.iteration == 0
    assert run.replay_sha256 == ("ef04b52c5d6cd5d99de144baef6aaf10bc138ea77acadd81cf6330adb7e44ed6")


def test_run_ends_with_the_iteration_that_reaches_the_budget() -> None:
    steps = [row[:2] for row in history(obedience(), Budget(max_env_steps=32 + 24 * 2))]
    assert steps == [(0, 32), (1, 56), (2, 80)]
    steps = [row[:2] for row in history(obedience(), Budget(max_env_steps=32 + 24 * 2 + 1))]
    assert steps == [(0, 32), (1, 56), (2, 80), (3, 104)]


def test_budget_spent_in_the_warm_up_leaves_weights_untrained() -> None:
    run = algorithm1(obedience(), Budget(max_env_steps=32))
    assert (run.iteration, run.state.version, run.env_steps) == (0, 0, 32)


def test_every_iteration_trains_one_version() -> None:
    versions: list[tuple[int, int]] = []
    algorithm1(
        obedience(),
        Budget(max_env_steps=104),
        4,
        lambda run: versions.append((run.iteration, run.state.version)),
    )
    assert versions == [(0, 0), (1, 1), (2, 2), (3, 3)]


def test_evaluations_run_at_multiples_of_env_steps_and_do_not_count_as_steps() -> None:
    # After iterations 0, 1, 2, ... the run has 32, 56, 80, 104, 128, 152 steps.
    run = algorithm1(obedience(eval_every=50, eval_episodes=5), Budget(max_env_steps=152))
    assert run.env_steps == 152
    assert sorted(run.evaluations) == [2, 4]
    assert {evaluation.episodes for evaluation in run.evaluations.values()} == {5}


def test_evaluations_do_not_change_training() -> None:
    often = history(settings(eval_every=1, eval_episodes=5))
    never = history(settings(eval_every=10**9))
    assert [row[:4] for row in often] == [row[:4] for row in never]
    assert all(row[4] is not None for row in often[1:])
    assert all(row[4] is None for row in never)


def test_run_stops_when_an_evaluation_reaches_the_stop_return() -> None:
    means = {i: e.mean for i, _, _, _, e in default_history() if e is not None}
    first, mean = next(iter(means.items()))
    assert len(default_history()) > first + 1
    stopped = history(settings(), Budget(max_env_steps=400, stop_return=mean))
    assert stopped == default_history()[: first + 1]


def test_unreached_stop_return_has_no_effect() -> None:
    assert history(settings(), Budget(max_env_steps=400, stop_return=1e9)) == default_history()


def test_buffer_discards_all_but_the_best_episodes() -> None:
    run = algorithm1(settings(), BUDGET)
    assert len(run.buffer) == 6
    assert run.experience.ids() == set(run.digests) == {entry.id for entry in run.buffer}


def test_lead_is_rejected_with_the_remedy() -> None:
    with pytest.raises(ConfigError, match=r"lead = 2: .*set lead = 0"):
        algorithm1(settings(lead=2), BUDGET)


def test_environments_are_closed_if_the_run_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    closed: list[Obedience] = []
    monkeypatch.setattr(Obedience, "close", lambda self: closed.append(self))

    def report(run: Run) -> None:
        if run.iteration == 1:
            raise RuntimeError("the callback failed")

    with pytest.raises(RuntimeError, match="the callback failed"):
        algorithm1(obedience(), BUDGET, n_environments=3, report=report)
    assert len(set(map(id, closed))) == 3
