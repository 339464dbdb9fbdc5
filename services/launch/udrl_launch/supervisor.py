"""Child processes: started, watched, started again, and ended with their parent."""

import logging
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from udrl.errors import RunFailed

log = logging.getLogger("udrl")

#: Exit codes that starting again would only repeat (``docs/operations.md``).
FINAL_CODES = frozenset({2, 7, 8, 9, 10})

#: A child that ended so often within ``_PERIOD_S`` seconds is given up.
_MAX_RESTARTS = 5
_PERIOD_S = 60.0
#: Seconds that services have to end after the run has ended or after SIGTERM.
END_S = 4.5


@dataclass
class Child:
    """A service in a process of its own.

    Attributes:
        name: for logs, and the name of its log file.
        arguments: of the ``udrl`` command.
        prefix: another program, with its arguments, that runs it, e.g. in a container.
        restarts: when it was started again.
    """

    name: str
    arguments: list[str]
    log_file: Path
    prefix: tuple[str, ...] = ()
    process: subprocess.Popen[bytes] | None = None
    restarts: list[float] = field(default_factory=list)
    done: bool = False

    def start(self) -> None:
        """Start the process."""
        with self.log_file.open("ab") as output:
            self.process = subprocess.Popen(  # noqa: S603 - our own program
                [
                    *self.prefix,
                    sys.executable,
                    "-m",
                    "udrl_launch",
                    *self.arguments,
                    "--parent",
                    str(os.getpid()),
                ],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                process_group=0,  # a Ctrl-C at the terminal is the parent's to handle
            )

    def last_words(self) -> str:
        """Return the end of its log."""
        lines = self.log_file.read_text(encoding="utf-8", errors="replace").splitlines()
        return "\n".join(lines[-5:])


class Supervisor:
    """Keeps children running until they are done.

    The first child is what the others work for: when it has ended well, nobody is started again,
    and the others get a few seconds to end too.

    Args:
        log_dir: where their output goes, a file each.
    """

    def __init__(self, log_dir: Path) -> None:
        log_dir.mkdir(parents=True, exist_ok=True)
        self._log_dir = log_dir
        self.children: list[Child] = []
        self._first_done: float | None = None

    def start(self, name: str, *arguments: str, prefix: tuple[str, ...] = ()) -> None:
        """Start ``PREFIX udrl ARGUMENTS`` as a child."""
        child = Child(name, list(arguments), self._log_dir / f"{name}.log", prefix)
        child.start()
        self.children.append(child)

    def check(self) -> None:
        """Start again what has died; call it now and then.

        Raises:
            RunFailed: a child ended in a way that it would end again.
        """
        for child in self.children:
            assert child.process is not None
            code = child.process.poll()
            if code is None or child.done:
                continue
            now = time.monotonic()
            if child is self.children[0] and code == 0:
                self._first_done = now
            if code == 0 or self._first_done is not None:
                if code != 0:
                    log.warning("%s ended with code %d when all was done", child.name, code)
                child.done = True
                continue
            child.restarts = [t for t in child.restarts if now - t < _PERIOD_S]
            if code in FINAL_CODES or len(child.restarts) >= _MAX_RESTARTS:
                failure = RunFailed(f"{child.name} ended with code {code}:\n{child.last_words()}")
                failure.exit_code = code if code in FINAL_CODES else failure.exit_code
                raise failure
            log.warning("%s ended with code %d and is started again", child.name, code)
            child.restarts.append(now)
            child.start()

    @property
    def done(self) -> bool:
        """Whether all children have ended, or the first has and the others had their time."""
        if self._first_done is not None and time.monotonic() - self._first_done > END_S:
            return True
        return all(child.done for child in self.children)

    def end(self) -> None:
        """End all children: SIGTERM, and SIGKILL for who does not listen."""
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
