"""The env steps per second of the whole system, compared with the limit that its parts set.

A training run with the preset and its budget is measured from the end of the warm-up on; evaluation
steps count. Then its parts are timed separately on the same machine: a bare environment step (with
the recorded actions of the run), a row of batched inference, an update. From these::

    limit = min(
        cores / (step + inference + update x updates per env step),
        1 / (update x updates per env step),
    )

The second is the learner's: version v needs version v-1, so training cannot use more cores.

Then the same parts are timed in one process per core simultaneously. Cores may share caches, memory
bandwidth, clock or execution units, so together they may do less than n times the work of one.

Needs an idle machine: ``make bench``.
"""

import argparse
import contextlib
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import torch

from udrl.acting import EpisodeGenerator
from udrl.algorithm1 import algorithm1
from udrl.commands import TRAINING_SEEDS
from udrl.config import Budget, Config, change
from udrl.environments import EnvironmentSpec, make_environment
from udrl.episode import Episode
from udrl.errors import UdrlError
from udrl.experience import Experience
from udrl.frame_stack import FrameStack
from udrl.graph import acting_graph
from udrl.inference import ActingFunction, probe_weights
from udrl.streams import Purpose, Stream, stream_key
from udrl.training import compute_deterministically, train, untrained
from udrl.value import value_loss
from udrl_inspect.agents import load_agent
from udrl_inspect.inspection import status_of
from udrl_launch.process import keep_freed_memory
from udrl_proto.codec import LARGEST, decode, decode_episode, encode_episode
from udrl_proto.messages import EpisodeMessage, Hello
from udrl_replay.progress import RunProgress
from udrl_replay.store import Store

_TICK = os.sysconf("SC_CLK_TCK")
#: Rows of the call that is timed.
_ROWS = 16
_ROLES = ("actor", "learner", "replay", "train")


class MeasuredWindow(NamedTuple):
    """A part of a run."""

    seconds: float
    steps: int
    iterations: int


class Usage(NamedTuple):
    """Env steps after the warm-up, and CPU seconds by role since the processes started."""

    steps: int
    cpu: dict[str, float]


class Parts(NamedTuple):
    """Seconds of each part, in one thread; a chained update has the threads of the run."""

    step: float
    inference: float
    update: float
    chained_update: float
    bare_update: float


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="LunarLander-v3")
    parser.add_argument("--max-env-steps", type=int, help="default: the preset's budget")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--lead", type=int)
    parser.add_argument("--actors", type=int)
    parser.add_argument("--envs-per-actor", type=int)
    parser.add_argument("--reference-steps", type=int, default=300_000)
    parser.add_argument(
        "--parts", type=Path, metavar="RUN_DIR", help="only time the parts of a run"
    )
    options = parser.parse_args()
    if options.parts:
        keep_freed_memory()
    compute_deterministically()
    if options.parts:
        print(json.dumps(_parts(*_recorded(options.parts))))
        return
    print(f"machine: {_machine()}")
    rows = []
    for folder in _folders(options.repeats):
        rows.append(measure(options, Path(folder)))
        ratio, system = (rows[-1][n] for n in ("system / limit", "system, env steps/s"))
        done = f"repetition {len(rows)} of {options.repeats}"
        print(f"{done}: {system:,.0f} env steps/s, {ratio:.2f} of the limit", flush=True)
    for name in rows[0]:
        values = [row[name] for row in rows]
        low, middle, high = min(values), statistics.median(values), max(values)
        print(f"{name:58} {middle:12,.2f}   ({low:,.2f} to {high:,.2f})")


def _folders(count: int) -> Any:
    for _ in range(count):
        with tempfile.TemporaryDirectory() as folder:
            yield folder


def _machine() -> str:
    model = [x for x in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in x]
    name = model[0].split(":")[1].strip() if model else platform.processor()
    versions = f"Python {platform.python_version()}, torch {torch.__version__}"
    return f"{os.cpu_count()} cores, {name}, {versions}"


def measure(options: argparse.Namespace, folder: Path) -> dict[str, float]:
    """Return the figures of one run."""
    run_dir = folder / "run"
    status, usages = _train(options, run_dir)
    first, last = usages[0], usages[-1]
    window = _window(run_dir)
    config, episodes = _recorded(run_dir)
    cores = os.cpu_count() or 1
    per_step = config.training.n_updates_per_iter * window.iterations / window.steps

    def limit(parts: Parts, per_step: float = per_step, cores: int = cores) -> float:
        work = parts.step + parts.inference + parts.update * per_step
        return min(cores / work, 1 / (parts.chained_update * per_step))

    parts, busy = _time_parts(run_dir, 1), _time_parts(run_dir, cores)
    system = window.steps / window.seconds
    reference = _reference_run(config, options.reference_steps)
    reference_speed = reference.steps / reference.seconds
    reference_per_step = config.training.n_updates_per_iter * reference.iterations / reference.steps
    return {
        "bare environment step, us": parts.step * 1e6,
        "bare environment, random actions, env steps/s per core": _random_speed(config),
        "inference, us per row (full call)": parts.inference * 1e6,
        "update, ms": parts.update * 1e3,
        "update in the run's threads, ms": parts.chained_update * 1e3,
        "bare update, on tensors in memory, ms": parts.bare_update * 1e3,
        "update / bare update": parts.update / parts.bare_update,
        "updates per 1,000 env steps": per_step * 1000,
        "limit, env steps/s": limit(parts),
        "system, env steps/s": system,
        "system / limit": system / limit(parts),
        "bare environment step while every core makes them, us": busy.step * 1e6,
        "update while every core makes them, ms": busy.update * 1e3,
        "limit while every core is busy, env steps/s": limit(busy),
        "system / limit while every core is busy": system / limit(busy),
        **{
            f"CPU of {role}, us per env step": 1e6
            * (last.cpu[role] - first.cpu[role]) / (last.steps - first.steps)
            for role in _ROLES
        },
        "reference implementation (1 core), env steps/s": reference_speed,
        "reference, updates per 1,000 env steps": reference_per_step * 1000,
        "reference / limit of one core": reference_speed / limit(parts, reference_per_step, 1),
        "replay service, CPU ms per episode (start-up included)": 1e3
         * last.cpu["replay"] / status["episodes"]["delivered"],
        "episode on the wire, bytes per env step": sum(
            len(encode_episode(e, "actor")) for e in episodes
        ) / sum(e.length for e in episodes),
        "weights, bytes per iteration": len(load_agent(run_dir).weights),
        "weights trained to weights acting, ms": 1e3 * status["weights_lag_s"],
    }  # fmt: skip


def _train(options: argparse.Namespace, run_dir: Path) -> tuple[dict[str, Any], list[Usage]]:
    """Train; return the last status, and samples of the CPU usage after the warm-up."""
    command = [
        sys.executable, "-m", "udrl_launch", "train", options.env,
        "--run-dir", str(run_dir), "--json",
    ]  # fmt: skip
    for name in ("max_env_steps", "lead", "actors", "envs_per_actor"):
        if (value := getattr(options, name)) is not None:
            command += [f"--{name.replace('_', '-')}", str(value)]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    assert process.stdout is not None
    usages: list[Usage] = []
    lags: list[float] = []
    while process.poll() is None:
        usage = _usage(run_dir, process.pid)
        if usage.steps and all(usage.cpu.values()):
            usages.append(usage)
        with contextlib.suppress(UdrlError):
            lags.append(status_of(run_dir).weights_lag_s)
        time.sleep(2)
    status: dict[str, Any] = json.loads(process.stdout.read().strip().splitlines()[-1])
    status["weights_lag_s"] = statistics.median(lags)
    return status, usages


def _usage(run_dir: Path, parent: int) -> Usage:
    """Return the progress of a run and the CPU usage of its processes."""
    try:
        window = _window(run_dir)
    except (FileNotFoundError, IndexError, ValueError):
        window = MeasuredWindow(0.0, 0, 0)
    cpu = dict.fromkeys(_ROLES, 0.0)
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # the process has ended
            words = (process / "cmdline").read_text().split("\0")
            ours = process.name == str(parent) or str(parent) in words
            role = next((word for word in words if word in _ROLES), None)
            if ours and role is not None:
                fields = (process / "stat").read_text().rsplit(")", 1)[1].split()
                cpu[role] += (int(fields[11]) + int(fields[12])) / _TICK
    return Usage(window.steps, cpu)


def _window(run_dir: Path) -> MeasuredWindow:
    """Return the part of a run after its warm-up."""
    lines = (run_dir / "metrics.csv").read_text().splitlines()
    names = lines[0].split(",")
    rows = [dict(zip(names, line.split(","), strict=True)) for line in lines[1:]]
    total = [int(r["env_steps"]) + int(r["eval_env_steps"]) for r in rows]
    return MeasuredWindow(
        float(rows[-1]["wall_s"]) - float(rows[0]["wall_s"]), total[-1] - total[0], len(rows) - 1
    )


def _recorded(run_dir: Path) -> tuple[Config, list[Episode]]:
    """Return a run's settings and the episodes in its buffer."""
    with closing(Store(run_dir, read_only=True)) as store:
        hello = store.fact("hello", Hello)
        held = [p.entry.id for p in store.buffer(store.fact("progress", RunProgress).iteration)]
        bodies = [store.episode_bodies([i], LARGEST)[0] for i in held]
    space = hello.environment.observation_space
    messages = [decode(body, EpisodeMessage, LARGEST) for body in bodies]
    return hello.config, [decode_episode(m, space) for m in messages]


def _time_parts(run_dir: Path, processes: int) -> Parts:
    """Return the means of the parts' times in processes that time them simultaneously."""
    command = [sys.executable, __file__, "--parts", str(run_dir)]
    running = [
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(processes)
    ]
    found = [Parts(*json.loads(process.communicate()[0])) for process in running]
    return Parts(*map(statistics.fmean, zip(*found, strict=True)))


def _parts(config: Config, episodes: list[Episode]) -> Parts:
    generator = EpisodeGenerator(config, 1)
    spec = generator.spec
    env = make_environment(config)
    steps = 0
    began = time.perf_counter()
    for episode in episodes[-200:]:
        env.reset(seed=_seed_of(config, episode.command_id))
        for action in episode.actions.tolist():
            env.step(action)
        steps += episode.length
    step = (time.perf_counter() - began) / steps

    graph = acting_graph(config.network, spec)
    call = ActingFunction(graph, probe_weights(graph)).call(_ROWS)
    inference = _seconds(call.run, 5000) / _ROWS

    experience = Experience(config, spec)
    for episode in episodes:
        experience.add(episode)
    ranked = experience.by_rank([e.command_id for e in episodes])

    def seconds_per_update(settings: Config) -> float:
        state, n = untrained(settings, spec), settings.training.n_updates_per_iter
        return _seconds(lambda: train(state, ranked, settings), 5) / n

    # The cores' limit depends on the CPU time in one thread, the learner's on the elapsed time.
    update = seconds_per_update(change(config, training_threads=1))
    chained = seconds_per_update(config)
    return Parts(step, inference, update, chained, _bare_update(config, spec))


def _bare_update(config: Config, spec: EnvironmentSpec) -> float:
    """Return the seconds of forward pass, backward pass and step, on tensors in memory.

    With a value function, its update is included.
    """
    state, n = untrained(config, spec), config.training.batch_size
    seen = spec.observation_space
    (shape,) = FrameStack(seen, config.network.frame_stack).shapes
    observed = ((torch.rand(n, *shape) * 255).to(getattr(torch, seen.dtype.name)),)
    command, action = torch.rand(n, 2), torch.randint(spec.action_space.n_parameters, (n,))

    def step(loss: torch.Tensor) -> None:
        state.optimizer.zero_grad()
        loss.backward()
        state.optimizer.step()

    def update() -> None:
        if state.behavior.value is not None:
            step(value_loss(state.behavior.value(observed), command[:, 0]))
        step(state.behavior.loss(state.behavior.forward_relative(observed, command), action))

    return _seconds(update, 100)


def _seed_of(config: Config, command_id: int) -> int:
    iteration, index = divmod(command_id, 1_000_000)
    stream = Stream(stream_key(config.seed, Purpose.COMMANDS, iteration, 0))
    return int(stream.integers(index + 1, *TRAINING_SEEDS)[index])


def _seconds(work: Callable[[], object], times: int) -> float:
    work()
    began = time.perf_counter()
    for _ in range(times):
        work()
    return (time.perf_counter() - began) / times


def _random_speed(config: Config) -> float:
    env = make_environment(config)
    actions = Stream(stream_key(0, Purpose.PROBE, 9)).integers(200_000, 0, int(env.action_space.n))  # type: ignore[attr-defined]
    env.reset(seed=1)
    began = time.perf_counter()
    steps = 0
    for action in actions.tolist():
        _, _, terminated, truncated, _ = env.step(action)
        steps += 1
        if terminated or truncated:
            env.reset()
            if time.perf_counter() - began > 3:
                break
    return steps / (time.perf_counter() - began)


def _reference_run(config: Config, steps: int) -> MeasuredWindow:
    """Return the second half of a short run of the reference implementation."""
    reports: list[MeasuredWindow] = []
    algorithm1(
        change(config, lead=0, eval_every=2**30),
        Budget(max_env_steps=steps),
        report=lambda run: reports.append(
            MeasuredWindow(time.perf_counter(), run.env_steps, run.iteration)
        ),
    )
    first, last = reports[len(reports) // 2], reports[-1]
    if last.iterations == first.iterations:
        raise SystemExit(
            f"--reference-steps {steps}: the warm-up takes {first.steps:,} env steps; raise it"
        )
    return MeasuredWindow(
        last.seconds - first.seconds, last.steps - first.steps, last.iterations - first.iterations
    )


if __name__ == "__main__":
    main()
