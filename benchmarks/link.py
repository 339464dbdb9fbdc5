"""An actor's network traffic, and its speed over slow links.

An actor connects to the replay service through a proxy that counts bytes, limits the bandwidth and
delays the data. The counts are of TCP's payload. Mutual TLS adds a few percent.

::

    .venv/bin/python benchmarks/link.py
    .venv/bin/python benchmarks/link.py --env TakeCover-v0 --links 0:0 10:20
"""

import argparse
import asyncio
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from udrl.errors import UdrlError
from udrl_inspect.inspection import status_of
from udrl_launch.training_run import free_port
from udrl_proto.reports import Status

_CHUNK = 16 * 1024


class LinkSpeed(NamedTuple):
    """Mbit/s in each direction (0: unlimited), and the one-way delay in milliseconds."""

    mbit_s: float
    delay_ms: float

    @classmethod
    def parse(cls, text: str) -> "LinkSpeed":
        """Return a link from ``MBIT_S:DELAY_MS``."""
        mbit_s, delay_ms = text.split(":")
        return cls(float(mbit_s), float(delay_ms))


class Proxy:
    """Forwards connections to a port on this machine, in a thread.

    Attributes:
        port: port that the proxy listens on.
        up: bytes sent by clients.
        down: bytes sent to clients.
    """

    def __init__(self, link: LinkSpeed, target: int) -> None:
        self._link, self._target = link, target
        self.up = self.down = 0
        self._loop = asyncio.new_event_loop()
        self._server = self._loop.run_until_complete(
            asyncio.start_server(self._serve, "127.0.0.1", 0)
        )
        self.port: int = self._server.sockets[0].getsockname()[1]
        threading.Thread(target=self._loop.run_forever, daemon=True).start()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            to_reader, to_writer = await asyncio.open_connection("127.0.0.1", self._target)
        except OSError:
            writer.close()
            return
        await asyncio.gather(
            self._pump(reader, to_writer, up=True), self._pump(to_reader, writer, up=False)
        )

    async def _pump(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, up: bool
    ) -> None:
        """Forward one direction, through a queue of data and its times of arrival."""
        # The queue holds what fits on the link: bandwidth times delay.
        mbit_s = self._link.mbit_s or 1000
        held = int(mbit_s * 125 * self._link.delay_ms / _CHUNK) + 4
        way: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(held)

        async def arrive() -> None:
            while True:
                due, data = await way.get()
                await asyncio.sleep(due - self._loop.time())
                if not data:
                    break
                with contextlib.suppress(OSError):  # the receiver is gone; still empty the queue
                    writer.write(data)
                    await writer.drain()

        arriving = asyncio.create_task(arrive())
        free = self._loop.time()
        with contextlib.suppress(OSError):
            while data := await reader.read(_CHUNK):
                if up:
                    self.up += len(data)
                else:
                    self.down += len(data)
                if self._link.mbit_s:
                    free = max(free, self._loop.time()) + len(data) / (self._link.mbit_s * 125_000)
                    await asyncio.sleep(free - self._loop.time())
                await way.put((self._loop.time() + self._link.delay_ms / 1000, data))
        await way.put((self._loop.time(), b""))
        await arriving
        writer.close()


@contextlib.contextmanager
def _started(*arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(
        [sys.executable, "-m", "udrl_launch", *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield process
    finally:
        process.terminate()
        process.wait(20)


def _status(run_dir: Path) -> Status | None:
    with contextlib.suppress(UdrlError):
        return status_of(run_dir)
    return None


def _completed(run_dir: Path, iteration: int) -> Status:
    """Wait until an iteration is complete, and return the status.

    Raises:
        TimeoutError: the iteration took more than ten minutes.
    """
    deadline = time.monotonic() + 600
    while time.monotonic() < deadline:
        status = _status(run_dir)
        if status is not None and status.iteration >= iteration:
            return status
        time.sleep(0.1)
    raise TimeoutError(f"iteration {iteration} was not complete after 600 s")


def measure(environment: str, link: LinkSpeed, seconds: float, run_dir: Path) -> dict[str, float]:
    """Return the figures of one actor over a link, after the first iterations."""
    port = free_port()
    proxy = Proxy(link, port)
    coordinator = _started(
        "train", environment, "--actors", "0", "--listen", f"tcp/127.0.0.1:{port}",
        "--max-env-steps", "100000000", "--run-dir", str(run_dir),
    )  # fmt: skip
    actor = _started("actor", "--connect", f"tcp/127.0.0.1:{proxy.port}", "--patience", "60")
    with coordinator, actor:
        first = _completed(run_dir, 3)
        up, down, began = proxy.up, proxy.down, time.monotonic()
        time.sleep(seconds)
        last = _completed(run_dir, _completed(run_dir, 0).iteration + 1)
        took = time.monotonic() - began
        up, down = proxy.up - up, proxy.down - down
    steps = last.env_steps + last.eval_env_steps - first.env_steps - first.eval_env_steps
    return {
        "env steps/s": steps / took,
        "up, KB/s": up / took / 1000,
        "down, KB/s": down / took / 1000,
        "up, bytes per env step": up / steps,
        "down, KB per iteration": down / (last.iteration - first.iteration) / 1000,
        "iterations": last.iteration - first.iteration,
        "failures": last.env_failures,
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="LunarLander-v3")
    parser.add_argument("--seconds", type=float, default=30)
    parser.add_argument(
        "--links", nargs="+", type=LinkSpeed.parse, metavar="MBIT_S:DELAY_MS",
        default=[LinkSpeed(0, 0), LinkSpeed(100, 10), LinkSpeed(10, 20), LinkSpeed(2, 40)],
    )  # fmt: skip
    options = parser.parse_args()
    print(f"{options.env}, one actor of 16 environments, {os.cpu_count()} cores")
    for link in options.links:
        with tempfile.TemporaryDirectory() as folder:
            found = measure(options.env, link, options.seconds, Path(folder) / "run")
        values = {name: round(value, 1) for name, value in found.items()}
        print(f"{link.mbit_s:g} Mbit/s, {link.delay_ms:g} ms each way: {json.dumps(values)}")


if __name__ == "__main__":
    main()
