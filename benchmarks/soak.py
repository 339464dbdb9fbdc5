"""Half an hour of a real run: memory, file descriptors, threads and speed.

::

    make soak                                        # 30 minutes
    .venv/bin/python benchmarks/soak.py --minutes 5

CartPole with its preset has short iterations, and therefore as many iterations, episodes and
messages as possible. Exit code 1: memory, descriptors or threads grew.
"""

import argparse
import csv
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

from udrl.errors import UdrlError
from udrl_replay.database import STORE_FILE
from udrl_replay.progress import RunProgress
from udrl_replay.store import Store

ROLES = ("replay", "learner", "actor")
#: Permitted relative growth from the second to the last quarter of the run.
_GROWTH = {"MiB": 0.03, "descriptors": 0.0, "threads": 0.0}


class ProcessSample(NamedTuple):
    """One process at one moment."""

    seconds: float
    role: str
    pid: int
    mib: float
    descriptors: int
    threads: int


class Pace(NamedTuple):
    """The run at one moment; ``store_mib`` is the size of its file."""

    seconds: float
    iteration: int
    env_steps: int
    store_mib: float


def main() -> int:
    """Train, sample and print a report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="CartPole-v1")
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--every", type=float, default=10.0, help="seconds between samples")
    parser.add_argument("--csv", type=Path, help="write all samples to this file")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        run_dir = Path(folder) / "run"
        command = [
            sys.executable, "-m", "udrl_launch", "train", options.env, "--run-dir", str(run_dir),
            "--max-env-steps", str(10**12),
        ]  # fmt: skip
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            samples, paces = _watch(process, run_dir, options.minutes * 60, options.every)
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(10)
    if options.csv:
        with options.csv.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([ProcessSample._fields, *samples])
    return 0 if report(samples, paces) else 1


def _watch(
    process: "subprocess.Popen[bytes]", run_dir: Path, seconds: float, every: float
) -> tuple[list[ProcessSample], list[Pace]]:
    samples: list[ProcessSample] = []
    paces: list[Pace] = []
    began = time.monotonic()
    while (now := time.monotonic() - began) < seconds:
        if process.poll() is not None:
            raise SystemExit(f"the run ended with code {process.returncode}; see its logs")
        samples += _look(process.pid, now)
        paces += _pace(run_dir, now)
        time.sleep(every)
    return samples, paces


def _look(parent: int, now: float) -> Iterator[ProcessSample]:
    for path in Path("/proc").glob("[0-9]*"):
        try:
            status = dict(
                line.split(":\t", 1) for line in (path / "status").read_text().splitlines()
                if ":\t" in line
            )  # fmt: skip
            if int(status["PPid"]) != parent:
                continue
            arguments = (path / "cmdline").read_bytes().split(b"\0")
            role = arguments[arguments.index(b"udrl_launch") + 1].decode()
            mib = int(status["VmRSS"].split()[0]) / 1024
            descriptors = len(list((path / "fd").iterdir()))
            yield ProcessSample(now, role, int(path.name), mib, descriptors, int(status["Threads"]))
        except (FileNotFoundError, ProcessLookupError, ValueError, KeyError):
            continue  # it ended, or is not a service


def _pace(run_dir: Path, now: float) -> Iterator[Pace]:
    try:
        with closing(Store(run_dir, read_only=True)) as store:
            progress = store.fact("progress", RunProgress)
    except UdrlError:
        return
    size = sum(f.stat().st_size for f in run_dir.glob(f"{STORE_FILE}*")) / 2**20
    yield Pace(now, progress.iteration, progress.env_steps, size)


def report(samples: list[ProcessSample], paces: list[Pace]) -> bool:
    """Print the quarters of the run; return whether nothing grew."""
    end = paces[-1].seconds
    quarters = [(end * i / 4, end * (i + 1) / 4) for i in range(4)]
    flat = True
    print(f"{end / 60:.0f} minutes, {paces[-1].iteration:,} iterations")
    print("| role | what | 1st quarter | 2nd | 3rd | 4th | flat |")
    print("|---|---|---|---|---|---|---|")
    for role in ROLES:
        pids = {s.pid for s in samples if s.role == role}
        for what, column in (("MiB", 3), ("descriptors", 4), ("threads", 5)):
            medians = [
                max(
                    statistics.median(float(s[column]) for s in of_one)
                    for pid in pids
                    if (of_one := [s for s in samples if s.pid == pid and a <= s.seconds <= b])
                )
                for a, b in quarters
            ]
            grows = medians[3] > medians[1] * (1 + _GROWTH[what])
            flat &= not grows
            shown = " | ".join(f"{m:,.0f}" for m in medians)
            print(f"| {role} | {what} | {shown} | {'no' if grows else 'yes'} |")
    inside = [[p for p in paces if a <= p.seconds <= b] for a, b in quarters]
    pace = [(q[-1].iteration - q[0].iteration) / (q[-1].seconds - q[0].seconds) for q in inside]
    print("| run | iterations/s | " + " | ".join(f"{p:.1f}" for p in pace) + " | |")
    steps = [(q[-1].env_steps - q[0].env_steps) / (q[-1].seconds - q[0].seconds) for q in inside]
    print("| run | env steps/s | " + " | ".join(f"{s:,.0f}" for s in steps) + " | |")
    print("| run | store, MiB | " + " | ".join(f"{q[-1].store_mib:.1f}" for q in inside) + " | |")
    return flat


if __name__ == "__main__":
    sys.exit(main())
