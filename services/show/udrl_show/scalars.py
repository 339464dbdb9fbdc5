"""The scalars of a run, under the names that other libraries use, for programs that plot them."""

from typing import NamedTuple

from udrl_proto.reports import Status

#: Columns of ``metrics.csv`` by tag; the tags are those of other libraries.
TAGS = {
    "rollout/ep_rew_mean": "explored_return",
    "rollout/desired_return_min": "commanded_min",
    "rollout/desired_return_max": "commanded_max",
    "train/loss": "loss",
    "replay/return_min": "return_min",
    "replay/return_mean": "return_mean",
    "replay/return_max": "return_max",
    "replay/admitted": "admitted",
    "time/iterations": "iteration",
    "time/wall_s": "wall_s",
}
#: Columns by tag for evaluations, which have their own env steps.
EVALUATION_TAGS = {
    "eval/mean_reward": "eval_mean",
    "eval/ci95_low": "eval_ci95_low",
    "eval/ci95_high": "eval_ci95_high",
    "eval/desired_return": "eval_desired_return",
    "eval/desired_horizon": "eval_desired_horizon",
}
#: Tags of values computed from two rows.
DERIVED_TAGS = ("rollout/ep_len_mean", "time/fps")


class Scalar(NamedTuple):
    """A value at one point of a run.

    Attributes:
        tag: its name.
        value: the value.
        env_steps: the point in env steps.
        wall_s: seconds that the run had been served.
    """

    tag: str
    value: float
    env_steps: int
    wall_s: float


class RowScalars:
    """Derives scalars from the rows of ``metrics.csv``, which must come in order.

    Args:
        eval_episodes: episodes of an evaluation.
    """

    def __init__(self, eval_episodes: int) -> None:
        self._eval_episodes = eval_episodes
        self._env_steps = 0
        self._timed = 0, 0.0  # env steps and wall time at the last value of time/fps

    def of(self, row: dict[str, str]) -> list[Scalar]:
        """Return the scalars of the next row."""
        env_steps, wall_s = int(row["env_steps"]), float(row["wall_s"])
        values = {tag: float(row[column]) for tag, column in TAGS.items() if row[column]}
        episodes = int(row["commands"]) - (self._eval_episodes if row["eval_mean"] else 0)
        if episodes > 0:
            values["rollout/ep_len_mean"] = (env_steps - self._env_steps) / episodes
        self._env_steps = env_steps
        if wall_s > self._timed[1]:  # iterations can be complete at the same moment
            values["time/fps"] = (env_steps - self._timed[0]) / (wall_s - self._timed[1])
            self._timed = env_steps, wall_s
        found = [Scalar(tag, value, env_steps, wall_s) for tag, value in values.items()]
        if row["eval_at_env_steps"]:
            evaluated = int(row["eval_at_env_steps"])
            found += [
                Scalar(tag, float(row[column]), evaluated, wall_s)
                for tag, column in EVALUATION_TAGS.items()
            ]
        return found


def final_scalars(status: Status) -> list[Scalar]:
    """Return the scalars of a run's final evaluation; none if it has not had one."""
    final = status.final_evaluation
    if final is None:
        return []
    values = {
        "eval/mean_reward": final.mean,
        "eval/ci95_low": final.ci95_low,
        "eval/ci95_high": final.ci95_high,
    }
    return [Scalar(tag, value, final.env_steps, status.wall_s) for tag, value in values.items()]
