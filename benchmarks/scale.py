"""Throughput of one replay service, with fleets of logical actors and synthetic episodes.

::

    .venv/bin/python benchmarks/scale.py --actors 1 10 100 1000 --kilobytes 20 1000

The replay service is real; the actors are a process of ``fleet.py``. A learner that does not train
delivers the same weights as every version. The table has the median of the repeats, and in brackets
their range.
"""

import argparse
import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from fleet import RUN, Load, Measured
from udrl.actions import Categorical
from udrl.checkpoint import encode_optimizer
from udrl.config import Budget, Config, build, flat
from udrl.environments import EnvironmentSpec
from udrl.errors import Interrupted
from udrl.graph import acting_graph
from udrl.spaces import Vector
from udrl.training import compute_deterministically, untrained
from udrl.weights import encode_weights
from udrl_launch.training_run import free_port
from udrl_proto import PROTOCOL, key_expressions, verbs
from udrl_proto import session as sessions
from udrl_proto.codec import encode
from udrl_proto.messages import ChangesRequest, Hello, JoinRequest, VersionMessage, WeightsMessage
from udrl_proto.replay_client import ReplayClient
from udrl_proto.reports import Status, StatusRequest
from udrl_proto.zenoh_transport import ZenohTransport
from udrl_replay.creation import write_config
from udrl_replay.progress import RunProgress
from udrl_replay.store import Store

_TICK = os.sysconf("SC_CLK_TCK")


def spec_of(kilobytes: int) -> EnvironmentSpec:
    """Return an environment whose longest episode has a number of kilobytes."""
    size = 8 if kilobytes < 100 else 256
    return EnvironmentSpec(
        observation_space=Vector(size=size),
        action_space=Categorical(n=4),
        max_episode_steps=kilobytes * 1000 // (4 * size + 5),
    )


# The learner that does not train, in this process.


class Announced(NamedTuple):
    """The time at which a weights version was published."""

    version: int
    at: float


def deliver_versions(
    endpoint: str, hello: Hello, stop: threading.Event, announced: list[Announced]
) -> None:
    """Deliver the same weights as every version until ``stop`` is set; record the times."""
    compute_deterministically()
    state = untrained(hello.config, hello.environment)
    for parameter in state.behavior.parameters():
        parameter.grad = parameter.new_zeros(parameter.shape)
    state.optimizer.step()  # a delivery needs the state of Adam
    weights, optimizer = encode_weights(state.weights), encode_optimizer(state)
    with contextlib.suppress(Interrupted), sessions.connect(endpoint, 30.0, stop) as session:
        client = ReplayClient(ZenohTransport(session), RUN, "learner scale", stop)
        client.request(
            verbs.JOIN,
            JoinRequest(
                role="learner", id="scale", host="bench", pid=1, software="0", numerics_class="c"
            ),
        )
        version = 1
        while not stop.is_set():
            request = ChangesRequest(learner="scale", version=version)
            changes = client.request(verbs.CHANGES, request)
            if changes.wait is not None:
                stop.wait(min(changes.wait.retry_after_s, 0.05))
                continue
            message = VersionMessage(
                learner="scale", version=version, weights=weights, optimizer=optimizer, loss=1.0,
                train_s=0.0,
            )  # fmt: skip
            client.request(verbs.VERSION, message)
            announced.append(Announced(version, time.monotonic()))
            news = encode(WeightsMessage(version=version, weights=weights))
            session.put(key_expressions.key(RUN, key_expressions.NEW_WEIGHTS), news)
            version += 1


# One measurement.


#: The figures of one fleet, in the order of the table.
UNITS = (
    "logical actors",
    "Zenoh sessions",
    "episode, KB",
    "acknowledged episodes/s",
    "MB/s",
    "acknowledgement p50, ms",
    "p99, ms",
    "commands p50, ms",
    "commands p99, ms",
    "replay CPU, ms/episode",
    "weights to all p50, ms",
    "weights to all p99, ms",
    "resident at first, MB",
    "resident at last, MB",
    "iterations",
    "queries sent again",
)


class LoadSample(NamedTuple):
    """The replay process at one moment: CPU seconds, resident MB, episodes accepted."""

    cpu: float
    resident: float
    accepted: int


@contextlib.contextmanager
def replay_service(run_dir: Path, hello: Hello, endpoint: str) -> Iterator[int]:
    """Run a real replay service; yield its process id."""
    Store.create(run_dir, hello=hello, progress=RunProgress()).close()
    write_config(run_dir, hello.config, Budget(max_env_steps=2**50))
    command = [
        sys.executable, "-m", "udrl_launch", "replay", hello.config.environment, "--resume",
        "--run-dir", str(run_dir), "--listen", endpoint,
    ]  # fmt: skip
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        yield process.pid
    finally:
        process.terminate()
        process.wait(10)


def measure(actors: int, kilobytes: int, options: argparse.Namespace) -> dict[str, float]:
    """Return the figures of one fleet."""
    spec = spec_of(kilobytes)
    config = build(
        Config,
        {
            "environment": "Synthetic-v0",
            "hidden": [64, 128, 128],
            "n_warm_up_episodes": max(100, 2 * actors),
            "n_episodes_per_iter": max(100, 2 * actors),
            "replay_size": options.replay_size,
            "last_few": 50,
            "lead": 2,
            "eval_every": 2**31 - 1,
        },
    )
    hello = Hello(
        protocol=PROTOCOL,
        software="0",
        run_id=RUN,
        settings=flat(config),
        environment=spec,
        graph=acting_graph(config.network, spec),
    )
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    stop = threading.Event()
    announced: list[Announced] = []
    samples: list[LoadSample] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        replay_service(Path(folder) / "run", hello, endpoint) as pid,
        sessions.connect(endpoint, 30.0) as session,
    ):
        client = ReplayClient(ZenohTransport(session), RUN, "scale", patience_s=30.0)
        learner = threading.Thread(
            target=deliver_versions, args=(endpoint, hello, stop, announced), daemon=True
        )
        learner.start()
        load = Load(
            endpoint, actors, min(actors, options.sessions), spec.max_episode_steps, options.seconds
        )
        report = Path(folder) / "fleet.json"
        fleet = subprocess.Popen([
            sys.executable, str(Path(__file__).with_name("fleet.py")),
            msgspec.json.encode(load).decode(), str(report),
        ])  # fmt: skip
        try:
            status = client.request(verbs.STATUS, StatusRequest())
            deadline = time.monotonic() + 60.0 + 3 * options.seconds
            while fleet.poll() is None and time.monotonic() < deadline:
                status = client.request(verbs.STATUS, StatusRequest())
                samples.append(_sample(pid, status))
                with contextlib.suppress(subprocess.TimeoutExpired):
                    fleet.wait(1.0)
            measured = msgspec.json.decode(report.read_bytes(), type=Measured)
        finally:
            fleet.kill()
            stop.set()
            learner.join(10)
    return _figures(load, kilobytes, measured, announced, samples, status)


def _sample(pid: int, status: Status) -> LoadSample:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    cpu = (int(fields[11]) + int(fields[12])) / _TICK
    return LoadSample(cpu, pages * os.sysconf("SC_PAGE_SIZE") / 1e6, status.episodes.accepted)


def _figures(
    load: Load,
    kilobytes: int,
    measured: Measured,
    announced: list[Announced],
    samples: list[LoadSample],
    status: Status,
) -> dict[str, float]:
    first, last = samples[len(samples) // 4], samples[-1]
    fan_out = [
        measured.arrivals[str(a.version)] - a.at
        for a in announced
        if str(a.version) in measured.arrivals
    ]
    ledger = status.episodes
    assert ledger.delivered == ledger.accepted + ledger.duplicate + ledger.rejected
    figures = (
        load.actors,
        load.sessions,
        kilobytes,
        measured.acknowledged,
        measured.acknowledged * kilobytes / 1e3,
        _percentile(measured.episode_s, 50),
        _percentile(measured.episode_s, 99),
        _percentile(measured.command_s, 50),
        _percentile(measured.command_s, 99),
        1e3 * (last.cpu - first.cpu) / max(1, last.accepted - first.accepted),
        _percentile(fan_out, 50),
        _percentile(fan_out, 99),
        first.resident,
        last.resident,
        status.iteration,
        measured.retries,
    )
    return dict(zip(UNITS, figures, strict=True))


def _percentile(seconds: list[float], percent: float) -> float:
    return 1e3 * float(np.percentile(seconds, percent)) if seconds else float("nan")


def main() -> None:
    """Measure every combination and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--actors", nargs="+", type=int, default=[1, 10, 100, 1000])
    parser.add_argument("--kilobytes", nargs="+", type=int, default=[20, 1000])
    parser.add_argument("--sessions", type=int, default=64, help="maximum number of Zenoh sessions")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--replay-size", type=int, default=500)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows = []
    print("| " + " | ".join(UNITS) + " |\n|" + "---|" * len(UNITS))
    for kilobytes in options.kilobytes:
        for actors in options.actors:
            repeats = [measure(actors, kilobytes, options) for _ in range(options.repeats)]
            rows += repeats
            cells = [_median_and_range([r[name] for r in repeats]) for name in UNITS]
            print("| " + " | ".join(cells) + " |", flush=True)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


def _median_and_range(values: list[float]) -> str:
    middle, low, high = statistics.median(values), min(values), max(values)
    return f"{middle:,.4g}" if low == high else f"{middle:,.4g} ({low:,.4g} to {high:,.4g})"


if __name__ == "__main__":
    main()
