"""Learning curves of the shipped presets over several seeds (``docs/results.md``).

::

    .venv/bin/python benchmarks/learning.py runs/learning --seeds 1 2 3

Runs that are already in the directory are not repeated. The result is a table, and a figure and a
CSV file per environment.
"""

import argparse
import csv
import json
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from udrl_inspect.agents import evaluate, evaluation_commands, load_agent
from udrl_inspect.inspection import read_status
from udrl_proto.reports import Status

ENVIRONMENTS = ("LunarLander-v3", "LunarLanderSparse-v3", "CartPole-v1")


class TrainedRun(NamedTuple):
    """A run: its last status, its evaluations, and an evaluation with greedy actions."""

    seed: int
    status: Status
    rows: list[dict[str, str]]
    greedy: Any


def main() -> None:
    """Train, evaluate, draw figures and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--envs", nargs="+", default=ENVIRONMENTS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    options = parser.parse_args()
    print("| environment | seed | env steps | sampled | greedy | best evaluation | minutes |")
    print("|---|---|---|---|---|---|---|")
    for env in options.envs:
        runs = [train(env, seed, options.folder / f"{env}-{seed}") for seed in options.seeds]
        for run in runs:
            print(row(env, run), flush=True)
        write(options.folder / f"{env}.csv", runs)
        draw(options.folder / f"{env}.png", env, runs)


def train(env: str, seed: int, run_dir: Path) -> TrainedRun:
    """Train with the preset, unless the run exists."""
    if not (run_dir / "weights.safetensors").exists():
        command = [sys.executable, "-m", "udrl_launch", "train", env, "--seed", str(seed)]
        subprocess.run([*command, "--run-dir", str(run_dir), "--resume", "--json"], check=True,
                       stdout=subprocess.DEVNULL)  # fmt: skip
    with (run_dir / "metrics.csv").open(newline="", encoding="utf-8") as file:
        rows = [r for r in csv.DictReader(file) if r["eval_mean"]]
    kept = run_dir / "greedy.json"
    if not kept.exists():
        agent = load_agent(run_dir)
        result = evaluate(agent, evaluation_commands(agent, episodes=100, temperature=0.0))
        kept.write_text(json.dumps(result.evaluation._asdict()), encoding="utf-8")
    return TrainedRun(
        seed, read_status(run_dir), rows, json.loads(kept.read_text(encoding="utf-8"))
    )


def row(env: str, run: TrainedRun) -> str:
    """Return a run as a row of the table."""
    final = run.status.final_evaluation
    assert final is not None
    best = max(run.rows, key=lambda r: float(r["eval_mean"]))
    half = (final.ci95_high - final.ci95_low) / 2
    greedy_half = (run.greedy["ci95_high"] - run.greedy["ci95_low"]) / 2
    return (
        f"| {env} | {run.seed} | {run.status.env_steps:,} | {final.mean:.1f} ± {half:.1f} | "
        f"{run.greedy['mean']:.1f} ± {greedy_half:.1f} | {float(best['eval_mean']):.1f} at "
        f"{int(best['eval_at_env_steps']):,} | {run.status.wall_s / 60:.1f} |"
    )


def write(path: Path, runs: list[TrainedRun]) -> None:
    """Write all evaluations as a tidy table."""
    names = ("eval_at_env_steps", "wall_s", "eval_mean", "eval_std", "eval_ci95_low",
             "eval_ci95_high", "eval_desired_return", "eval_desired_horizon")  # fmt: skip
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["seed", *names])
        for run in runs:
            writer.writerows([run.seed, *(r[n] for n in names)] for r in run.rows)


def draw(path: Path, env: str, runs: list[TrainedRun]) -> None:
    """Draw a thin line per seed and a thick one for their mean."""
    figure = Figure(figsize=(7, 4.3), layout="constrained")
    axes = figure.add_subplot()
    for run, style in zip(runs, ("-", "--", ":", "-."), strict=False):
        steps = [int(r["eval_at_env_steps"]) for r in run.rows]
        axes.plot(steps, [float(r["eval_mean"]) for r in run.rows], style, lw=1,
                  label=f"seed {run.seed}")  # fmt: skip
    count = min(len(run.rows) for run in runs)
    mean = [statistics.fmean(float(run.rows[i]["eval_mean"]) for run in runs) for i in range(count)]
    steps = [int(r["eval_at_env_steps"]) for r in runs[0].rows[:count]]
    axes.plot(steps, mean, color="black", lw=2.5, label="mean of the seeds")
    axes.set(xlabel="env steps", ylabel="mean return of 100 episodes, sampled actions", title=env)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
