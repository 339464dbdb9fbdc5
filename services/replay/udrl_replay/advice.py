"""What to look at when a run does not learn."""

import math

from udrl.evaluation import return_text
from udrl.fitting import fits
from udrl.setting_groups import NetworkSettings
from udrl_proto.reports import IterationStatus
from udrl_replay.run_state import RunState

#: Share of the budget after which a run should obtain more than random actions do.
_PATIENCE = 1 / 3


def advice(run: RunState) -> str:
    """Return what most likely keeps a run from learning; empty: it learns, or it is too early.

    It does not learn if no evaluation obtains more than the warm-up did, after a third of the
    budget.
    """
    best = run.progress.best_mean
    if best is None or run.progress.env_steps < _PATIENCE * run.budget.max_env_steps:
        return ""
    warm_up = run.store.iterations(-1, 1)[0]
    if best > warm_up.explored_return:
        return ""
    return (
        f"the run does not learn: its best evaluation is {return_text(best)}, the warm-up's mean "
        f"return {return_text(warm_up.explored_return)}. Most likely "
        f"{cause(run.config.network, warm_up)}. See "
        f"'Signs of trouble' in docs/metrics.md"
    )


def cause(network: NetworkSettings, warm_up: IterationStatus) -> str:
    """Return the most likely reason why a run does not learn, and the remedy."""
    # The mean size of a return is not stored; this is it where all have one sign, and near it else.
    spread = warm_up.return_max - warm_up.return_min
    size = max(abs(warm_up.explored_return), spread / 4)
    length = warm_up.env_steps / warm_up.commands
    if spread == 0 and math.isclose(warm_up.explored_return, warm_up.return_max):
        return (
            "too little data: all of the warm-up returned the same, so there is nothing to tell "
            "apart; raise n_warm_up_episodes or warm_up_hold, or begin with a dataset"
        )
    for name, scale, what, usual in (
        ("return_scale", network.return_scale, "returns", size),
        ("horizon_scale", network.horizon_scale, "lengths", length),
    ):
        if not fits(scale, usual):
            return (
                f"{name} = {scale:g}: it makes {scale * usual:.2g} of {what} of {usual:.3g}, usual "
                f"in the warm-up, and the network needs the order of 1; try {name} = auto"
            )
    return (
        "too little data: give it more env steps (--max-env-steps), more warm-up episodes "
        "(n_warm_up_episodes) or more updates (n_updates_per_iter)"
    )
