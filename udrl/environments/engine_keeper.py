"""Ends game engines whose owner is gone; a program of its own, started by :mod:`.doom`.

ViZDoom's engines are processes that outlive a killed parent and ignore SIGTERM. This one waits for
the end of its standard input, which comes when the owner ends in whatever way, and then kills
every engine that has the owner's mark in its environment, and takes away the shared memory that
nobody else will. It imports the standard library only: it should start at once, and weigh little.
"""

import contextlib
import os
import signal
import sys
import time
from pathlib import Path

#: Environment variable that marks the engines of an owner.
MARK = "UDRL_ENGINES_OF"

_INSTANCE = b"+viz_instance_id"
#: Looks without a find after which no engine can be left that was just being started.
_LOOKS = 3
_PAUSE_S = 0.2


def keep(mark: str) -> None:
    """Wait for the owner's end, then kill its engines."""
    sys.stdin.buffer.read()
    looks = 0
    while looks < _LOOKS:
        found = _engines(mark)
        for pid, instance in found:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
            for left in Path("/dev/shm").glob(f"ViZDoom*{instance}"):  # noqa: S108 - its choice
                left.unlink(missing_ok=True)
        looks = 0 if found else looks + 1
        time.sleep(_PAUSE_S)


def _engines(mark: str) -> list[tuple[int, str]]:
    """Return pid and instance of each living engine with the mark."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdecimal():
            continue
        with contextlib.suppress(OSError):  # it ended meanwhile, or belongs to somebody else
            marked = f"{MARK}={mark}".encode() in (entry / "environ").read_bytes().split(b"\0")
            command = (entry / "cmdline").read_bytes().split(b"\0")
            if marked and _INSTANCE in command[:-1]:
                found.append((int(entry.name), command[command.index(_INSTANCE) + 1].decode()))
    return found


if __name__ == "__main__":
    keep(sys.argv[1])
