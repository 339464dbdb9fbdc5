"""A program that kills game engines whose owner has ended; started by :mod:`.doom`.

ViZDoom's engines are processes that outlive a killed parent and ignore SIGTERM. This program waits
for the end of its standard input, which closes however the owner ends. It then kills every engine
with the owner's mark in its environment variables, and removes the engine's shared memory. It only
imports the standard library, to start quickly and use little memory.
"""

import contextlib
import os
import signal
import sys
import time
from pathlib import Path

#: Environment variable that marks the engines of an owner.
MARK = "UDRL_ENGINES_OF"

#: Command-line argument of an engine that comes before its instance id.
_INSTANCE = b"+viz_instance_id"
#: Number of scans without a match before exit: an engine may just be starting.
_SCANS = 3
_PAUSE_S = 0.2


def keep(mark: str) -> None:
    """Wait until the owner ends, then kill its engines."""
    sys.stdin.buffer.read()
    empty_scans = 0
    while empty_scans < _SCANS:
        found = _engines(mark)
        for pid, instance in found:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
            for left in Path("/dev/shm").glob(f"ViZDoom*{instance}"):  # noqa: S108 - ViZDoom's
                left.unlink(missing_ok=True)
        empty_scans = 0 if found else empty_scans + 1
        time.sleep(_PAUSE_S)


def _engines(mark: str) -> list[tuple[int, str]]:
    """Return pid and instance id of each running engine with the mark."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdecimal():
            continue
        with contextlib.suppress(OSError):  # it has ended, or belongs to another user
            marked = f"{MARK}={mark}".encode() in (entry / "environ").read_bytes().split(b"\0")
            command = (entry / "cmdline").read_bytes().split(b"\0")
            if marked and _INSTANCE in command[:-1]:
                found.append((int(entry.name), command[command.index(_INSTANCE) + 1].decode()))
    return found


if __name__ == "__main__":
    keep(sys.argv[1])
