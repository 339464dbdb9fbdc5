"""Fault injection: disturb real runs at random moments, and compare their results.

For each fault, a run is disturbed ``--repeats`` times, at moments drawn from ``--seed``, and
compared with an undisturbed run (``docs/reliability.md`` explains the columns)::

    .venv/bin/python benchmarks/chaos.py --repeats 3

Exit code 1: a digest differs, a ledger does not balance, or a run did not end as expected.
"""

import argparse
import os
import random
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import msgspec

from cut_cable import CutCable
from disturbed_environments import CURSED, HEALED, SLOW_ONE
from disturbed_run import DisturbedRun, TooLate, digests, is_balanced
from faults import FAULTS, Fault
from severed_link import SeveredLink
from udrl.commands import CommandSampler
from udrl.config import Config, change
from udrl.environments.making import make_environment
from udrl.environments.specification import specify
from udrl.errors import RunFailed
from udrl.replay_buffer import Entry, ReplayBuffer
from udrl_launch.settings import Settings, gather
from udrl_proto.reports import Status

_HERE = Path(__file__).parent
#: ``--hang-timeout`` of runs with hanging environments. In other runs it must exceed the stops.
_HANG_S = 4.0
_NEVER_S = 60.0
#: Seconds after a disturbance in which log lines count as its detection.
_NOTICED_S = 4.0
_OPTIONS: dict[str, dict[str, Any]] = {
    # Small enough for seconds, large enough for evaluations, evictions and dozens of versions.
    "CartPole-v1": {
        "max_env_steps": 60_000, "batch_size": 64, "hidden": [16, 16], "n_warm_up_episodes": 12,
        "n_episodes_per_iter": 8, "n_updates_per_iter": 40, "replay_size": 40, "last_few": 10,
        "eval_every": 5000, "eval_episodes": 5,
    },
    "LunarLander-v3": {"max_env_steps": 150_000, "eval_every": 50_000, "eval_episodes": 10},
}  # fmt: skip


class Injection(msgspec.Struct):
    """Times until the effects of a disturbance, in seconds; None: not measured."""

    detected: float | None = None
    reported_by: str = ""
    reconnected: float | None = None
    next_episode: float | None = None
    next_iteration: float | None = None


class FaultRow(msgspec.Struct):
    """The result of a run with one fault."""

    fault: str
    equal: bool
    balanced: bool
    as_expected: bool
    wall_s: float
    injections: list[Injection]
    env_failures: int
    restarts: int
    duplicates: int
    lost: int
    remark: str = ""

    @property
    def passed(self) -> bool:
        """Whether the fault did not affect the result."""
        return self.equal and self.balanced and self.as_expected and not self.lost


def main() -> int:
    """Disturb the runs, compare them and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="CartPole-v1", choices=sorted(_OPTIONS))
    parser.add_argument("--faults", nargs="+", metavar="NAME", choices=[f.name for f in FAULTS])
    parser.add_argument("--repeats", type=int, default=3, help="disturbances per run, at most 5")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--limit", type=float, default=240.0, help="time limit of a run in seconds")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows to FILE")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the runs in FOLDER")
    options = parser.parse_args()
    os.environ["PYTHONPATH"] = os.pathsep.join([str(_HERE), *sys.path])
    os.environ["UDRL_CHAOS_SEED"] = str(options.seed)
    wanted = [f for f in FAULTS if not options.faults or f.name in options.faults]
    with tempfile.TemporaryDirectory(prefix="udrl-chaos-") as scratch:
        folder = options.keep or Path(scratch)
        undisturbed, wall_s = _undisturbed(options, folder / "undisturbed")
        print(f"undisturbed: {undisturbed.commands.accepted} episodes, {wall_s:.1f} s\n")
        print(_HEADER, flush=True)
        rows = []
        for fault in wanted:
            if fault.link is CutCable and not CutCable.is_possible():
                print(f"| {fault.name} | needs root and iproute2 |{' |' * 12}", flush=True)
                continue
            rows.append(disturb(fault, options, folder, undisturbed))
            print(_line(rows[-1]), flush=True)
    if options.json:
        options.json.write_bytes(msgspec.json.format(msgspec.json.encode(rows), indent=1))
    for row in rows:
        if row.remark:
            print(f"\n{row.fault}: {row.remark}")
    return 0 if all(row.passed for row in rows) else 1


def _settings(options: argparse.Namespace, environment: str | None) -> Settings:
    values = _OPTIONS[options.env] | {"seed": options.seed, "envs_per_actor": 4}
    settings = gather(options.env, options=values)
    if environment is None:
        return settings
    limit = gym.spec(options.env).max_episode_steps
    config = change(
        settings.config,
        environment=f"disturbed_environments:{environment}-v0",
        environment_kwargs={"inner": options.env},
        max_episode_steps=limit,
    )
    return settings._replace(config=config)


def _undisturbed(options: argparse.Namespace, run_dir: Path) -> tuple[Status, float]:
    began = time.monotonic()
    run = DisturbedRun(_settings(options, None), run_dir, SeveredLink(), options.limit, _NEVER_S)
    with run.going():
        failure = run.failure()
    if failure is not None:
        raise failure
    return run.status(), time.monotonic() - began


def disturb(
    fault: Fault, options: argparse.Namespace, folder: Path, undisturbed: Status
) -> FaultRow:
    """Return the result of a run with one fault."""
    name = fault.name.replace(" ", "-")
    os.environ[SLOW_ONE] = str(folder / f"{name}.slow")
    chance = random.Random(f"{options.seed}-{fault.name}")  # noqa: S311
    os.environ[CURSED] = str(_curse(_settings(options, None).config, chance))
    began = time.monotonic()
    hang_s = _HANG_S if "Hanging" in str(fault.environment) else _NEVER_S
    settings = _settings(options, fault.environment)
    run = DisturbedRun(settings, folder / name, fault.link(), options.limit, hang_s)
    spans: list[tuple[float, float]] = []
    failure: RunFailed | None = None
    remarks: list[str] = []
    try:
        with run.going():
            for number in range(options.repeats if fault.begin else 0):
                # One in each of equal slices between 10 % and 90 % of the run.
                part = 0.1 + 0.8 * (number + chance.random()) / options.repeats
                moment = max(int(part * undisturbed.commands.accepted), run.accepted + 1)
                run.wait(lambda m=moment: run.accepted >= m or run.is_over, f"episode {moment}")  # type: ignore[misc]
                run.pass_by(chance.uniform(0.0, 0.1))
                if run.is_over:
                    remarks.append("the run ended before its last disturbances")
                    break
                start = time.time()
                fault.begin(run)  # type: ignore[misc]
                spans.append((start, start if fault.name.startswith("kill") else time.time()))
            failure = run.failure()
        if fault.stops_the_run:
            remarks.append(_check_failure(failure, run))
            failure = None
            _heal_and_finish(run, options)
    except TooLate as error:
        remarks.append(str(error))
        failure = RunFailed(str(error))
    if failure is not None:
        remarks.append(f"the run failed: {failure}")
    status = run.status()
    counts = {
        "env_failures": status.env_failures,
        "restarts": sum(c.starts - 1 for c in run.children("actor", "learner", "replay")),
    }
    if fault.shows_in is not None and not counts[fault.shows_in]:
        remarks.append(f"WRONG: the fault did not occur, {fault.shows_in} is 0")
    return FaultRow(
        fault=fault.name,
        equal=digests(status) == digests(undisturbed) and status.exact,
        balanced=is_balanced(status) and not run.unbalanced,
        as_expected=failure is None and not any(r.startswith("WRONG") for r in remarks),
        wall_s=time.monotonic() - began,
        injections=[_measure(run, fault, *span) for span in spans],
        **counts,
        duplicates=status.episodes.duplicate,
        lost=status.commands.outstanding,
        remark="; ".join([*remarks, *run.unbalanced[:1]]),
    )


def _curse(config: Config, chance: random.Random) -> int:
    """Return the environment seed of an exploratory command early in a run."""
    any_buffer = ReplayBuffer(config.buffer)  # seeds do not depend on its content
    any_buffer.admit([Entry(0.0, 0, 1)])
    with closing(make_environment(config)) as env:
        sampler = CommandSampler(config, specify(env, config))
    commands = sampler.explore(chance.randint(3, 10), any_buffer)
    return chance.choice(commands).environment_seed


def _check_failure(failure: RunFailed | None, run: DisturbedRun) -> str:
    """Check the error of a run that must fail, and its reproduction; return a remark."""
    text = str(failure)
    match = re.search(r"command (\d+) .*udrl reproduce RUN_DIR \1", text, flags=re.DOTALL)
    if failure is None or failure.exit_code != RunFailed.exit_code or match is None:
        return f"WRONG: expected exit code 9 and a command to reproduce it: {text}"
    reproduction = [sys.executable, "-m", "udrl_launch", "reproduce", str(run.run_dir), match[1]]
    try:
        tried = subprocess.run(reproduction, capture_output=True, timeout=3 * _HANG_S, check=False)
    except subprocess.TimeoutExpired:
        return f"code 9, command {match[1]}; the reproduction hangs"
    if tried.returncode == 0:
        return f"WRONG: command {match[1]} does not fail in the reproduction"
    return f"code 9, command {match[1]}; the reproduction ends with code {tried.returncode}"


def _heal_and_finish(run: DisturbedRun, options: argparse.Namespace) -> None:
    """Repair the environment and continue with ``--resume``, as the documentation says."""
    command = [
        sys.executable, "-m", "udrl_launch", "train", run.settings.config.environment,
        "--run-dir", str(run.run_dir), "--resume",
    ]  # fmt: skip
    subprocess.run(
        command, env=os.environ | {HEALED: "1"}, timeout=options.limit, check=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip


def _measure(run: DisturbedRun, fault: Fault, start: float, end: float) -> Injection:
    """Return the effects of a disturbance from logs and observations."""
    found = Injection()
    gone = "actor|learner" if "replay" in fault.lose else "|".join(fault.lose)
    waits = "has been waiting|waiting for a replay service"
    pattern = waits if "replay" in fault.lose else rf"^({gone}) \S+ disconnected"
    lines = [x for x in run.lines(pattern, start) if x.at < end + _NOTICED_S]
    if fault.lose and lines:
        found.detected, found.reported_by = lines[0].at - start, lines[0].service.split("-")[0]
    peers = 1 if fault.name in ("kill actor", "stop actor") else len(run.children(*gone.split("|")))
    back = run.lines(rf"^({gone}) \S+ connected", end) if gone else []
    if back:
        found.reconnected = back[min(peers, len(back)) - 1].at - end
    after = [m for m in run.moments if m.at > end]
    if after:
        accepted, iteration = after[0].accepted, after[0].iteration
        found.next_episode = next((m.at - end for m in after if m.accepted > accepted), None)
        found.next_iteration = next((m.at - end for m in after if m.iteration > iteration), None)
    return found


_HEADER = (
    "| fault | times | digests | ledgers | detected, s | by | reconnected, s | next episode, s "
    "| next iteration, s | restarts | failures | run again | lost | run, s |\n"
    "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|"
)


def _line(row: FaultRow) -> str:
    times = row.injections
    reporters = sorted({t.reported_by for t in times if t.reported_by})
    cells = [
        row.fault,
        str(len(times)) if times else "all along",
        "equal" if row.equal else "**DIFFERENT**",
        "balanced" if row.balanced else "**UNBALANCED**",
        _spread([t.detected for t in times]),
        ", ".join(reporters) or "-",
        _spread([t.reconnected for t in times]),
        _spread([t.next_episode for t in times]),
        _spread([t.next_iteration for t in times]),
        str(row.restarts),
        str(row.env_failures),
        str(row.duplicates),
        str(row.lost),
        f"{row.wall_s:.0f}" if row.as_expected else f"**{row.wall_s:.0f}**",
    ]
    return f"| {' | '.join(cells)} |"


def _spread(values: Sequence[float | None]) -> str:
    known = [v for v in values if v is not None]
    return f"{statistics.median(known):.2f} ({max(known):.2f})" if known else "-"


if __name__ == "__main__":
    sys.exit(main())
