"""Memory of a full replay buffer of images: in the learner, and when a learner joins.

::

    .venv/bin/python benchmarks/replay_memory.py               # 500 episodes of 800 steps

Episodes are noise in the size of TakeCover's frames, all of the same length. The warm-up fills the
buffer. Then the learner is killed, and the next one has to fetch the whole buffer at once.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from udrl.errors import UdrlError
from udrl_inspect.inspection import read_status

_SIZE = (1, 32, 32)


class NoisyImages(gym.Env[Any, Any]):
    """Noise in the shape of TakeCover's frames; a reward of 1 per step, up to the time limit."""

    observation_space = gym.spaces.Box(0, 255, _SIZE, np.uint8)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin an episode."""
        super().reset(seed=seed)
        return self._look(), {}

    def step(self, action: Any) -> Any:
        """Advance."""
        return self._look(), 1.0, False, False, {}

    def _look(self) -> Any:
        return self.np_random.integers(0, 256, _SIZE, np.uint8)


gym.register("NoisyImages-v0", f"{__name__}:NoisyImages")


class ProcessMemory(NamedTuple):
    """A process: its role and id, its resident memory and the peak of it, in MB."""

    role: str
    pid: int
    mb: float
    peak_mb: float


def main() -> None:
    """Fill the buffer, kill the learner, and print memory."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=500)
    parser.add_argument("--steps", type=int, default=800)
    options = parser.parse_args()
    megabytes = options.episodes * options.steps * np.prod(_SIZE) / 1e6
    print(f"{options.episodes} episodes of {options.steps} steps: {megabytes:.0f} MB of frames")
    with tempfile.TemporaryDirectory() as folder:
        run_dir = Path(folder) / "run"
        settings = {
            "frame_stack": 8, "max_episode_steps": options.steps, "batch_size": 64,
            "n_updates_per_iter": 1, "n_episodes_per_iter": 1, "hidden": [64, 128],
            "n_warm_up_episodes": options.episodes, "replay_size": options.episodes,
            "eval_every": 10**9,
        }  # fmt: skip
        assignments = [a for name, value in settings.items() for a in ("--set", f"{name}={value}")]
        process = subprocess.Popen(
            [sys.executable, "-m", "udrl_launch", "train", "replay_memory:NoisyImages-v0",
             "--run-dir", str(run_dir), "--max-env-steps", str(10**12), *assignments],
            env=os.environ | {"PYTHONPATH": str(Path(__file__).parent)},
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            _follow(process, run_dir)
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(30)


def _follow(process: "subprocess.Popen[bytes]", run_dir: Path) -> None:
    print(
        "| | learner with the buffer, MB | more than without | at most | replay service at most |"
    )
    print("|---|---|---|---|---|")
    empty = _idle_learner(process)
    _report("filled in the warm-up", process, run_dir, empty)
    old = _find(process, "learner")
    os.kill(old.pid, signal.SIGKILL)
    _forget_peak(_find(process, "replay"))
    _wait(
        process, lambda: any(m.role == "learner" and m.pid != old.pid for m in _children(process))
    )
    _report("fetched by a new learner", process, run_dir, empty)


def _report(what: str, process: "subprocess.Popen[bytes]", run_dir: Path, empty_mb: float) -> None:
    """Print memory after the learner has trained three more versions."""
    version = _version(run_dir)
    _wait(process, lambda: _version(run_dir) >= version + 3)
    learner, replay = _find(process, "learner"), _find(process, "replay")
    print(
        f"| {what} | {learner.mb:.0f} | {learner.mb - empty_mb:.0f} | {learner.peak_mb:.0f} | "
        f"{replay.peak_mb:.0f} |"
    )


def _idle_learner(process: "subprocess.Popen[bytes]") -> float:
    """Return the MB of an idle learner, when they have not changed for two seconds."""
    seen: list[float] = []

    def is_steady() -> bool:
        seen.extend(m.mb for m in _children(process) if m.role == "learner")
        return len(seen) > 20 and seen[-1] == seen[-11]

    _wait(process, is_steady)
    return seen[-1]


def _forget_peak(memory: ProcessMemory) -> None:
    Path(f"/proc/{memory.pid}/clear_refs").write_text("5", encoding="utf-8")


def _find(process: "subprocess.Popen[bytes]", role: str) -> ProcessMemory:
    return next(m for m in _children(process) if m.role == role)


def _children(parent: "subprocess.Popen[bytes]") -> list[ProcessMemory]:
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            lines = (path / "status").read_text(encoding="utf-8").splitlines()
            status = dict(line.split(":\t", 1) for line in lines if ":\t" in line)
            if int(status["PPid"]) != parent.pid:
                continue
            arguments = (path / "cmdline").read_bytes().split(b"\0")
            role = arguments[arguments.index(b"udrl_launch") + 1].decode()
            now, peak = (int(status[n].split()[0]) * 1024 / 1e6 for n in ("VmRSS", "VmHWM"))
            found.append(ProcessMemory(role, int(path.name), now, peak))
        except (FileNotFoundError, ProcessLookupError, ValueError, KeyError):
            continue  # it ended, or is not a service
    return found


def _version(run_dir: Path) -> int:
    try:
        return read_status(run_dir).weights_version
    except UdrlError:
        return 0


def _wait(process: "subprocess.Popen[bytes]", done: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 600
    while not done():
        if process.poll() is not None or time.monotonic() > deadline:
            raise SystemExit(f"the run ended with code {process.poll()}, or timed out")
        time.sleep(0.2)


if __name__ == "__main__":
    main()
