"""The board's effect on the speed of a run: the same run with and without a board in use.

::

    .venv/bin/python benchmarks/board.py

Runs with and without a board alternate. All have the same settings, so the same iterations are
compared. A client requests news from the board once a second, as a page does. The board starts
during the run; figures are printed with and without its start.
"""

import argparse
import csv
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import NamedTuple

UDRL = [sys.executable, "-m", "udrl_launch"]


class MeasuredRun(NamedTuple):
    """Figures of a run.

    Attributes:
        speed: env steps per second of the whole run.
        later: env steps per second of the second half, when the board has started.
        requests: number of requests to the board.
        cpu_s: CPU seconds of the board, including its start.
        start_s: CPU seconds of the board's start.
    """

    speed: float
    later: float
    requests: int = 0
    cpu_s: float = 0.0
    start_s: float = 0.0


def train(folder: Path, env_steps: int, *, watched: bool) -> MeasuredRun:
    """Train, and return the figures of the run."""
    run_dir = folder / "run"
    training = subprocess.Popen(
        [*UDRL, "train", "LunarLander-v3", "--run-dir", str(run_dir), "--json",
         "--max-env-steps", str(env_steps)],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    found = _watch(run_dir, training) if watched else (0, 0.0, 0.0)
    if training.wait():
        raise SystemExit(f"the run failed with exit code {training.returncode}")
    with (run_dir / "metrics.csv").open() as file:
        rows = [(int(r["env_steps"]), float(r["wall_s"])) for r in csv.DictReader(file)]
    middle = next(row for row in rows if row[0] >= env_steps / 2)
    last = rows[-1]
    later = (last[0] - middle[0]) / (last[1] - middle[1])
    return MeasuredRun(last[0] / last[1], later, *found)


def _watch(run_dir: Path, training: subprocess.Popen[bytes]) -> tuple[int, float, float]:
    """Poll a board until training ends; return requests, CPU seconds, and those of its start."""
    while not (run_dir / "run.sqlite").exists():
        time.sleep(0.1)
    board = subprocess.Popen([*UDRL, "board", str(run_dir)], stdout=subprocess.PIPE, text=True)
    assert board.stdout is not None
    address = board.stdout.readline().split()[1]
    start_s = _cpu_s(board.pid)
    requests, after, run_id = 0, -1, ""
    while _is_running(training, 1.0):
        url = f"{address}news?after={after}&run={run_id}"
        with urllib.request.urlopen(url, timeout=20) as answer:  # noqa: S310 - our own
            news = json.load(answer)
        requests += 1
        run_id = news["hello"]["run_id"] if news["hello"] else run_id
        after = news["iterations"][-1]["iteration"] if news["iterations"] else after
    cpu_s = _cpu_s(board.pid)
    board.terminate()
    board.wait(20)
    return requests, cpu_s, start_s


def _is_running(training: subprocess.Popen[bytes], seconds: float) -> bool:
    """Wait, and return whether training is still in progress."""
    try:
        training.wait(seconds)
    except subprocess.TimeoutExpired:
        return True
    return False


def _cpu_s(pid: int) -> float:
    """Return the CPU seconds of a process (Linux)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env-steps", type=int, default=600_000)
    parser.add_argument("--times", type=int, default=5)
    options = parser.parse_args()
    runs: dict[bool, list[MeasuredRun]] = {False: [], True: []}
    for number in range(options.times):
        for watched in (False, True):
            with tempfile.TemporaryDirectory() as folder:
                run = train(Path(folder), options.env_steps, watched=watched)
            runs[watched].append(run)
            figures = f"{run.speed:,.0f} env steps/s, second half {run.later:,.0f}"
            if watched:
                figures += (
                    f"; {run.requests} requests to the board, which used {run.cpu_s:.1f} s of CPU, "
                    f"{run.start_s:.1f} s of them to start"
                )
            print(f"{number + 1}: {'with' if watched else 'without'}: {figures}", flush=True)
    for watched, found in runs.items():
        for name in ("speed", "later"):
            speeds = [getattr(run, name) for run in found]
            print(
                f"{'with' if watched else 'without'}, {name}: median "
                f"{statistics.median(speeds):,.0f}, {min(speeds):,.0f} to {max(speeds):,.0f}"
            )


if __name__ == "__main__":
    main()
