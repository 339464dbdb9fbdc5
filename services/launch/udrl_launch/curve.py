"""The picture of a learning curve, drawn from ``metrics.csv`` alone."""

import csv
from pathlib import Path

from udrl.errors import ConfigError


def draw(run_dir: Path, title: str) -> Path:
    """Draw evaluation returns against env steps into the run's directory; return the picture.

    Raises:
        ConfigError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise ConfigError(
            'the learning curve needs matplotlib; install it with: pip install "udrl[plot]"'
        ) from error
    with (run_dir / "metrics.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    figure = Figure(figsize=(7, 4.3), layout="constrained")
    axes = figure.add_subplot()
    steps = [int(r["env_steps"]) for r in rows]
    for name, label, style in (
        ("return_mean", "mean of the replay buffer", "--"),
        ("explored_return", "exploratory episodes, mean of an iteration", ":"),
    ):
        axes.plot(steps, [float(r[name]) for r in rows], style, color="0.6", label=label, lw=1)
    evaluated = [r for r in rows if r["eval_mean"]]
    at = [int(r["eval_at_env_steps"]) for r in evaluated]
    low, mean, high = (
        [float(r[n]) for r in evaluated] for n in ("eval_ci95_low", "eval_mean", "eval_ci95_high")
    )
    axes.fill_between(at, low, high, color="C0", alpha=0.25, lw=0)
    axes.plot(at, mean, "o-", color="C0", ms=3, label="evaluation, mean and 95 % interval")
    axes.set(xlabel="env steps", ylabel="return", title=title)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    picture = run_dir / "learning_curve.png"
    figure.savefig(picture, dpi=130)
    return picture
