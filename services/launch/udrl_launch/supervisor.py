"""Child processes: started, monitored, restarted, and ended with their parent."""

import logging
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from udrl.errors import RunFailed, UdrlError
from udrl_launch.paths import STARTED_IN, child_environment_variables
from udrl_replay.remedies import unwritable

log = logging.getLogger("udrl")

#: Exit codes that a restart would only repeat (``docs/operations-reference.md``).
FINAL_CODES = frozenset({2, 7, 8, 9, 10})

#: Deaths of a child without progress in between after which the run fails.
_MOST_DEATHS = 6
#: Maximum size of a child's log, in bytes; if it is larger, only the last quarter of this is kept.
_LONGEST_LOG = 1 << 20
#: Seconds for services to end after the run has ended or after SIGTERM.
END_S = 4.0
#: Seconds that the first child may run on after another has ended without an error; a replay
#: service continues for 10 s after the end of the run.
_AHEAD_S = 20.0


@dataclass
class Child:
    """A service in a child process.

    Attributes:
        name: name in log messages, and of the log file.
        arguments: arguments of the ``udrl`` command.
        log_file: file for its standard output and standard error.
        prefix: another program, with its arguments, that runs the command, e.g. in a container.
        process: the process; None before the first start.
        starts: number of starts.
        deaths: number of deaths since the last progress.
        work: progress at the last death.
        done: whether it has ended and is not restarted.
        done_at: when that was noticed, in seconds on the monotonic clock.
    """

    name: str
    arguments: list[str]
    log_file: Path
    prefix: tuple[str, ...] = ()
    process: subprocess.Popen[bytes] | None = None
    starts: int = 0
    deaths: int = 0
    work: int = -1
    done: bool = False
    done_at: float = 0.0

    def start(self) -> None:
        """Start the process.

        Raises:
            StoreError: its log cannot be written.
            UdrlError: the process cannot be started.
        """
        self.starts += 1
        try:
            self.log_file.parent.mkdir(parents=True, exist_ok=True)
            output = self.log_file.open("ab")
        except OSError as error:
            raise unwritable(self.log_file, error) from error
        with output:
            try:
                self.process = subprocess.Popen(  # noqa: S603 - our own program
                    [
                        *self.prefix,
                        sys.executable,
                        "-P",  # the user's files must not shadow Python's modules
                        "-m",
                        "udrl_launch",
                        *self.arguments,
                        "--parent",
                        str(os.getpid()),
                    ],
                    cwd=STARTED_IN,
                    env=child_environment_variables(),
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=output,
                    process_group=0,  # the parent handles Ctrl-C in the terminal
                )
            except OSError as error:
                raise UdrlError(
                    f"cannot start {self.name}: {error.strerror}; free memory, processes or open "
                    f"files, or raise their limits"
                ) from error

    def log_tail(self) -> str:
        """Return the last lines of the log, or why it cannot be read."""
        try:
            return "\n".join(_end_of(self.log_file, 10_000).splitlines()[-5:])
        except OSError as error:
            return f"{self.log_file} cannot be read: {error.strerror}"

    def shorten_log(self) -> None:
        """Shorten a long log, if it can be written: environments may print without limit."""
        with suppress(OSError):
            if self.log_file.stat().st_size > _LONGEST_LOG:
                end = _end_of(self.log_file, _LONGEST_LOG // 4)
                # The child continues to append. What it writes before the file is truncated is
                # lost; what it writes afterwards follows, because its file is in append mode.
                with self.log_file.open("r+", encoding="utf-8") as log_file:
                    log_file.write(f"... earlier output was removed\n{end}")
                    log_file.truncate()


def _end_of(file: Path, size: int) -> str:
    """Return the last ``size`` bytes of a file, without an incomplete first line."""
    with file.open("rb") as opened:
        length = opened.seek(0, os.SEEK_END)
        opened.seek(max(0, length - size))
        end = opened.read(size).decode("utf-8", errors="replace")
    return end if length <= size else end.partition("\n")[2]


#: Signals that end a process, and their usual meaning.
_SIGNALS = {
    signal.SIGKILL: "killed, or out of memory",
    signal.SIGSEGV: "a crash in native code",
    signal.SIGABRT: "native code aborted",
    signal.SIGBUS: "a crash in native code, or a full disk behind shared memory",
    signal.SIGILL: "native code for another processor",
    signal.SIGFPE: "native code divided by zero",
}


def how_it_ended(code: int) -> str:
    """Describe how a process ended; ``code`` is that of :class:`subprocess.Popen`."""
    if code >= 0:
        return f"ended with code {code}"
    try:
        number = signal.Signals(-code)
    except ValueError:
        return f"ended by signal {-code}"
    meaning = f" ({_SIGNALS[number]})" if number in _SIGNALS else ""
    return f"ended by {number.name}{meaning}"


class Supervisor:
    """Keeps children running until they are done.

    When the first child has ended without an error, no child is restarted any more, and the others
    get a few seconds to end. Until then, another that has ended without an error is restarted too,
    after a while: code of an environment can end its process with any code.

    Args:
        log_dir: folder for the logs, one file per child; it is created if it is missing.

    Attributes:
        work: progress of the children of each role (``actor``: episodes, ``learner``: versions).
            The run fails if a child dies repeatedly without progress, even at long intervals.
    """

    def __init__(self, log_dir: Path) -> None:
        self._log_dir = log_dir
        self.children: list[Child] = []
        self.work: dict[str, int] = {}
        self._first_done: float | None = None

    def start(self, name: str, *arguments: str, prefix: tuple[str, ...] = ()) -> None:
        """Start ``PREFIX udrl ARGUMENTS`` as a child.

        Raises:
            UdrlError: it cannot be started.
        """
        child = Child(name, list(arguments), self._log_dir / f"{name}.log", prefix)
        child.start()
        self.children.append(child)

    def check(self) -> None:
        """Restart children that died; call it regularly.

        Raises:
            RunFailed: a child ended with an error that a restart would only repeat, or died too
                often without progress.
            UdrlError: a child cannot be started again.
        """
        for child in self.children:
            assert child.process is not None
            child.shorten_log()
            code = child.process.poll()
            now = time.monotonic()
            if code is None or (child.done and not self._is_missing(child, now)):
                continue
            if child is self.children[0] and code == 0:
                self._first_done = now
            if self._first_done is not None or (code == 0 and not child.done):
                if code != 0:
                    log.warning("%s %s after the run was complete", child.name, how_it_ended(code))
                child.done, child.done_at = True, now
                continue
            work = self.work.get(child.arguments[0] if child.arguments else "", 0)
            child.deaths = 1 if work != child.work else child.deaths + 1
            child.work = work
            if code in FINAL_CODES or child.deaths >= _MOST_DEATHS:
                often = "" if code in FINAL_CODES else f" {child.deaths} times without progress"
                failure = RunFailed(
                    f"{child.name} {how_it_ended(code)}{often}:\n{child.log_tail()}"
                )
                failure.exit_code = code if code in FINAL_CODES else failure.exit_code
                raise failure
            log.warning("%s %s and is restarted", child.name, how_it_ended(code))
            child.done = False
            child.start()

    def _is_missing(self, child: Child, now: float) -> bool:
        """Return whether a child has ended although the run continues."""
        return self._first_done is None and now - child.done_at > _AHEAD_S

    @property
    def done(self) -> bool:
        """Whether all children have ended, or the first has and the grace period is over."""
        if self._first_done is not None and time.monotonic() - self._first_done > END_S:
            return True
        return all(child.done for child in self.children)

    def end(self) -> None:
        """End all children with SIGTERM, then those that remain with SIGKILL."""
        processes = [c.process for c in self.children if c.process is not None]
        for process in processes:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
        deadline = time.monotonic() + END_S
        for process in processes:
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
