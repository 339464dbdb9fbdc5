"""Advice for a run that does not learn."""

import math

from udrl.automatic_settings import scale_fits
from udrl.evaluation import return_text
from udrl.setting_groups import NetworkSettings
from udrl_proto.reports import IterationStatus
from udrl_replay.run_state import RunState

#: Fraction of the budget after which a run should obtain more than random actions do.
_BUDGET_FRACTION = 1 / 3


def advice(run: RunState) -> str:
    """Return the most likely reason why a run does not learn, and the remedy; else an empty string.

    A run does not learn if after a third of the budget no evaluation has a higher mean return than
    the warm-up, or than the dataset that replaces it.
    """
    best = run.progress.best_mean
    if best is None or run.progress.env_steps < _BUDGET_FRACTION * run.budget.max_env_steps:
        return ""
    warm_up = run.store.iterations(-1, 1)[0]
    if best > warm_up.explored_return:
        return ""
    has_dataset = run.config.commands.dataset is not None
    reason = cause(run.config.network, warm_up, has_dataset=has_dataset)
    return (
        f"the run does not learn: its best evaluation is {return_text(best)}, the "
        f"{'dataset' if has_dataset else 'warm-up'}'s mean return "
        f"{return_text(warm_up.explored_return)}. Most likely {reason}. See "
        f"'Signs of trouble' on the documentation's page on metrics"
    )


def cause(network: NetworkSettings, warm_up: IterationStatus, *, has_dataset: bool = False) -> str:
    """Return the most likely reason why a run does not learn, and the remedy.

    Args:
        network: settings of the network.
        warm_up: the run's iteration 0.
        has_dataset: whether its episodes are a dataset's.
    """
    # The mean absolute return is not stored. This equals it if all returns have the same sign, and
    # approximates it otherwise.
    spread = warm_up.return_max - warm_up.return_min
    size = max(abs(warm_up.explored_return), spread / 4)
    length = warm_up.env_steps / warm_up.commands
    if spread == 0 and math.isclose(warm_up.explored_return, warm_up.return_max):
        if has_dataset:
            return (
                "too little data: all episodes of the dataset have the same return, so there are "
                "no better ones to learn from; start with a dataset that has better ones, too"
            )
        return (
            "too little data: all warm-up episodes have the same return, so there are no better "
            "ones to learn from; raise n_warm_up_episodes or warm_up_hold_steps, or start with a "
            "dataset"
        )
    source = "dataset" if has_dataset else "warm-up"
    for name, scale, what, usual in (
        ("return_scale", network.return_scale, "returns", size),
        ("horizon_scale", network.horizon_scale, "lengths", length),
    ):
        if not scale_fits(scale, usual):
            return (
                f"{name} = {scale:g}: it scales the {source}'s typical {what} of {usual:.3g} to "
                f"{scale * usual:.2g}, but the network needs values around 1; try {name} = auto"
            )
    more = "more warm-up episodes (n_warm_up_episodes)"
    if has_dataset:
        more = "a dataset with more or better episodes"
    return (
        f"too little data: give it more env steps (--max-env-steps), {more} or more updates "
        f"(n_updates_per_iter)"
    )
