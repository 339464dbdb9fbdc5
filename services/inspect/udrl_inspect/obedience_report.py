"""Obedience of an agent: obtained against commanded returns and horizons.

The report is stored in the run's directory, where model cards and the board read it. It is
reproducible: commands and seeds depend only on the run.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta

from udrl.atomic_files import write_atomically
from udrl.commands import Command
from udrl.errors import ConfigError, InvalidData, StoreError
from udrl.evaluation import summarise
from udrl.file_remedies import file_remedy
from udrl.obedience_statistics import (
    Means,
    correlation,
    evenly,
    mean_absolute_error,
    mean_of_nearest,
    obeyed,
    spread,
)
from udrl.setting_groups import Temperature
from udrl.strategies import nearest
from udrl.targets import ReturnInTime
from udrl_inspect.agents import Agent, EvaluationResult, evaluate_all, evaluation_commands

#: Name of the report in a run's directory.
FILE = "obedience.json"
#: Default tolerance: largest difference between mean obtained and commanded return, as a fraction
#: of the reachable range.
TOLERANCE = 0.1

_AtLeast0 = Annotated[float, Meta(ge=0)]
_Count = Annotated[int, Meta(ge=1)]


class ObediencePoint(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The results of one command.

    Attributes:
        desired_return: commanded return.
        desired_horizon: commanded horizon, steps.
        episodes: number of episodes.
        return_mean: mean obtained return.
        return_std: standard deviation of the sample.
        return_ci95_low: lower end of the 95 % confidence interval of the mean.
        return_ci95_high: upper end of that interval.
        length_mean: mean length, steps.
        length_std: standard deviation of the sample.
        length_ci95_low: lower end of the 95 % confidence interval of the mean.
        length_ci95_high: upper end of that interval.
    """

    desired_return: float
    desired_horizon: _Count
    episodes: _Count
    return_mean: float
    return_std: _AtLeast0
    return_ci95_low: float
    return_ci95_high: float
    length_mean: float
    length_std: _AtLeast0
    length_ci95_low: float
    length_ci95_high: float


class Agreement(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Agreement of obtained means with commands, over a range of commands.

    Attributes:
        low: lowest command.
        high: highest command.
        mean_absolute_error: mean absolute difference between obtained and commanded values.
        correlation: correlation of commands and obtained means; 0 if all means are equal.
    """

    low: float
    high: float
    mean_absolute_error: _AtLeast0
    correlation: Annotated[float, Meta(ge=-1, le=1)]


class ObedienceReport(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The report on an agent.

    Attributes:
        format: version of the file format.
        run_id: id of the agent's run.
        environment: Gymnasium id.
        weights_version: the agent's weights version.
        temperature: sampling temperature; 0 = most likely action.
        episodes: number of episodes for each command.
        reachable_low: lowest reachable return (:func:`udrl.obedience_statistics.spread`).
        reachable_high: highest reachable return.
        tolerance: largest difference between a mean and its command that counts as obeyed.
        by_return: results by commanded return in increasing order, each with a suitable horizon.
        by_horizon: results by commanded horizon in increasing order, with the desired return of
            evaluations. Empty if the horizon has no effect, or all episodes have the same length.
        all_returns: agreement over all of ``by_return``.
        obeyed: agreement over the range in which the agent obeys. None: there is no such range.
        all_horizons: agreement of commanded horizons and lengths, in steps. None: not measured.
    """

    format: Literal[1] = 1
    run_id: str
    environment: str
    weights_version: _Count
    temperature: Temperature
    episodes: _Count
    reachable_low: float
    reachable_high: float
    tolerance: _AtLeast0
    by_return: Annotated[list[ObediencePoint], Meta(min_length=2)]
    by_horizon: list[ObediencePoint]
    all_returns: Agreement
    obeyed: Agreement | None
    all_horizons: Agreement | None

    @property
    def best(self) -> ObediencePoint:
        """The command with the highest mean return."""
        return max(self.by_return, key=lambda point: point.return_mean)


class ObediencePlan(NamedTuple):
    """The commands of a report.

    Attributes:
        by_return: the commands for each desired return.
        by_horizon: the commands for each desired horizon.
        reachable: the lowest and the highest reachable return.
    """

    by_return: list[list[Command]]
    by_horizon: list[list[Command]]
    reachable: tuple[float, float]

    @property
    def total(self) -> int:
        """Number of episodes."""
        return sum(map(len, self.by_return + self.by_horizon))


def plan_commands(
    agent: Agent,
    *,
    points: int,
    episodes: int,
    temperature: float | None = None,
    desired_returns: tuple[float, float] | None = None,
) -> ObediencePlan:
    """Return the commands for a report on an agent.

    Args:
        agent: the agent.
        points: number of desired returns, and of desired horizons; at least 2.
        episodes: number of episodes for each.
        temperature: sampling temperature. None: as in the run's evaluations.
        desired_returns: range of desired returns. None: the reachable returns.

    Raises:
        ConfigError: there is only one desired return.
    """
    returns = [entry.episode_return for entry in agent.buffer]
    lengths = [entry.length for entry in agent.buffer]

    def commands(desired_return: float | None, desired_horizon: int | None) -> list[Command]:
        return evaluation_commands(
            agent, episodes=episodes, temperature=temperature, desired_return=desired_return,
            desired_horizon=desired_horizon,
        )  # fmt: skip

    common = spread(returns, points)
    has_horizon = ReturnInTime(agent.config.network).has_horizon
    by_return = [
        commands(value, nearest(mean_of_nearest(value, returns, lengths)) if has_horizon else None)
        for value in (evenly(*desired_returns, points) if desired_returns else common)
    ]
    by_return = list({group[0].desired_return: group for group in by_return}.values())
    if len(by_return) < 2:
        only = by_return[0][0].desired_return
        if desired_returns is not None:
            low, high = desired_returns
            raise ConfigError(
                f"--desired-returns {low:g}:{high:g}: all commands would have a desired return of "
                f"{only:g}, because this run's are integers of at least 1; give a wider range"
            )
        raise ConfigError(
            f"all returns in the replay buffer are {only:g}, so there is no range to command; give "
            f"one with --desired-returns LOW:HIGH"
        )
    horizons = spread(lengths, points) if has_horizon else []
    whole = sorted({max(1, nearest(value)) for value in horizons})
    by_horizon = [commands(None, value) for value in whole] if len(whole) > 1 else []
    return ObediencePlan(by_return, by_horizon, (common[0], common[-1]))


def measure(
    agent: Agent,
    plan: ObediencePlan,
    tolerance: float | None = None,
    ended: Callable[[], object] = lambda: None,
) -> ObedienceReport:
    """Run the commands of a plan and return the report.

    Args:
        agent: the agent of the plan.
        plan: the commands.
        tolerance: largest difference between a mean and its command that counts as obeyed. None:
            :data:`TOLERANCE` of the reachable range.
        ended: called at the end of each episode.

    Raises:
        EnvironmentFault: the environment failed three times under the same command.
    """
    results = evaluate_all(agent, plan.by_return + plan.by_horizon, ended=ended)
    by_return = list(map(_point, results[: len(plan.by_return)]))
    by_horizon = list(map(_point, results[len(plan.by_return) :]))
    low, high = plan.reachable
    means = Means(
        *(
            np.array([getattr(point, name) for point in by_return])
            for name in ("desired_return", "return_mean", "return_ci95_low", "return_ci95_high")
        )
    )
    # If all returns in the buffer are equal, their range is 0.
    if tolerance is None:
        tolerance = TOLERANCE * (high - low or float(np.ptp(means.commanded)))
    where = obeyed(means, tolerance)
    lengths = [point.length_mean for point in by_horizon]
    return ObedienceReport(
        run_id=agent.run_id,
        environment=agent.config.environment,
        weights_version=agent.version,
        temperature=results[0].temperature,
        episodes=len(results[0].returns),
        reachable_low=low,
        reachable_high=high,
        tolerance=tolerance,
        by_return=by_return,
        by_horizon=by_horizon,
        all_returns=_agreement(means.commanded.tolist(), means.mean.tolist()),
        obeyed=None
        if where is None
        else _agreement(means.commanded[where].tolist(), means.mean[where].tolist()),
        all_horizons=_agreement([float(point.desired_horizon) for point in by_horizon], lengths)
        if by_horizon
        else None,
    )


def _point(result: EvaluationResult) -> ObediencePoint:
    returns, lengths = result.evaluation, summarise(result.lengths)
    return ObediencePoint(
        desired_return=result.desired_return,
        desired_horizon=result.desired_horizon,
        episodes=returns.episodes,
        return_mean=returns.mean,
        return_std=returns.std,
        return_ci95_low=returns.ci95_low,
        return_ci95_high=returns.ci95_high,
        length_mean=lengths.mean,
        length_std=lengths.std,
        length_ci95_low=lengths.ci95_low,
        length_ci95_high=lengths.ci95_high,
    )


def _agreement(commanded: Sequence[float], obtained: Sequence[float]) -> Agreement:
    return Agreement(
        low=commanded[0],
        high=commanded[-1],
        mean_absolute_error=mean_absolute_error(commanded, obtained),
        correlation=correlation(commanded, obtained),
    )


def save_report(run_dir: Path, report: ObedienceReport) -> Path:
    """Write a report to a run's directory, and return the file's path.

    Raises:
        StoreError: the file cannot be written.
    """
    path = run_dir / FILE
    try:
        write_atomically(path, msgspec.json.format(msgspec.json.encode(report), indent=2) + b"\n")
    except OSError as error:
        what_to_do = file_remedy(error, "make the directory writable")
        raise StoreError(f"{path}: {error.strerror}; {what_to_do}") from error
    return path


def report_of_agent(agent: Agent, run_dir: Path) -> ObedienceReport | None:
    """Return a run's report if it was measured with this agent's weights, else None.

    Raises:
        InvalidData: the file is invalid.
    """
    report = load_report(run_dir)
    if report is None:
        return None
    is_same = (report.run_id, report.weights_version) == (agent.run_id, agent.version)
    return report if is_same else None


def load_report(run_dir: Path) -> ObedienceReport | None:
    """Return the report in a run's directory; None if there is none.

    Raises:
        InvalidData: the file is invalid.
    """
    path = run_dir / FILE
    try:
        return msgspec.json.decode(path.read_bytes(), type=ObedienceReport)
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError, msgspec.DecodeError) as error:
        raise InvalidData(
            f"{path}: {error}; delete it, or measure again: udrl obedience {run_dir}"
        ) from error
