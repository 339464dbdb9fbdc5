"""A warning for agents that do worse with greedy actions, as is common after sampled training."""

import math
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from udrl.commands import Command
from udrl.evaluation import return_text, summarise
from udrl_inspect.agents import Agent, evaluation_commands, stored_evaluation
from udrl_replay.store import Store


def caution(agent: Agent, run_dir: Path, command: Command, returns: Sequence[float]) -> str:
    """Return a warning if greedy episodes obtained far less than the run's sampled evaluations.

    Far less means more than a standard deviation of the sampled returns, and significantly less.

    Args:
        agent: the agent.
        run_dir: the run's directory.
        command: command of the episodes; nothing is compared unless it is that of evaluations.
        returns: the obtained returns.

    Returns:
        The finding and its remedy; empty if there is no finding, or nothing to compare with.

    Raises:
        StoreError: the run cannot be read.
    """
    usual = evaluation_commands(agent, episodes=1)[0]
    is_usual = (command.desired_return, command.desired_horizon) == (
        usual.desired_return,
        usual.desired_horizon,
    )
    if not (returns and is_usual and command.temperature == 0 < usual.temperature):
        return ""
    with closing(Store(run_dir, read_only=True)) as store:
        found = (
            stored_evaluation(store, agent)
            or store.last_evaluation(is_final=True)
            or store.last_evaluation(is_final=False)
        )
    if found is None:
        return ""
    greedy, sampled = summarise(returns), found.evaluation
    spread = max(greedy.std, sampled.std)
    surely_below = greedy.mean + 1.96 * spread / math.sqrt(greedy.episodes)
    if surely_below >= sampled.ci95_low or sampled.mean - greedy.mean <= sampled.std:
        return ""
    return (
        f"greedy: mean return {return_text(greedy.mean)}; sampled evaluations of this run reach "
        f"{return_text(sampled.mean)}; leave out --greedy or --temperature 0"
    )
