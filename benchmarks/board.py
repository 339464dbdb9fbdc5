"""What a board costs the run that it shows: the same run with and without one that is looked at.

::

    .venv/bin/python benchmarks/board.py

Runs with and without take turns. A client asks the board for news once a second, as a page does.
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path

UDRL = [sys.executable, "-m", "udrl_launch"]


def train(run_dir: Path, env_steps: int, *, watched: bool) -> tuple[float, int]:
    """Train, and return env steps per second and how often the board was asked."""
    training = subprocess.Popen(
        [*UDRL, "train", "LunarLander-v3", "--run-dir", str(run_dir), "--json",
         "--max-env-steps", str(env_steps)],
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    done, asked = threading.Event(), [0]
    watcher = threading.Thread(target=_watch, args=(run_dir, done, asked))
    if watched:
        watcher.start()
    out, _ = training.communicate()
    done.set()
    if watched:
        watcher.join()
    status = json.loads(out.strip().splitlines()[-1])
    return status["env_steps"] / status["wall_s"], asked[0]


def _watch(run_dir: Path, done: threading.Event, asked: list[int]) -> None:
    while not (run_dir / "run.sqlite").exists():
        time.sleep(0.1)
    board = subprocess.Popen([*UDRL, "board", str(run_dir)], stdout=subprocess.PIPE, text=True)
    assert board.stdout is not None
    address = board.stdout.readline().split()[1]
    after = -1
    while not done.wait(1.0):
        with urllib.request.urlopen(f"{address}news?after={after}", timeout=20) as answer:  # noqa: S310 - our own
            news = json.load(answer)
        asked[0] += 1
        if news["iterations"]:
            after = news["iterations"][-1]["iteration"]
    board.terminate()
    board.wait(20)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env-steps", type=int, default=300_000)
    parser.add_argument("--times", type=int, default=3)
    options = parser.parse_args()
    speeds: dict[bool, list[float]] = {False: [], True: []}
    for number in range(options.times):
        for watched in (False, True):
            with tempfile.TemporaryDirectory() as folder:
                speed, asked = train(Path(folder) / "run", options.env_steps, watched=watched)
            speeds[watched].append(speed)
            what = f"with a board, asked {asked} times" if watched else "without"
            print(f"{number + 1}: {what}: {speed:,.0f} env steps/s", flush=True)
    for watched, found in speeds.items():
        print(
            f"{'with' if watched else 'without'}: median {statistics.median(found):,.0f}, "
            f"{min(found):,.0f} to {max(found):,.0f} env steps/s"
        )


if __name__ == "__main__":
    main()
