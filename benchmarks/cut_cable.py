"""Two machines and a switch as Linux network namespaces. Needs root and iproute2."""

import contextlib
import os
import shutil
import subprocess
from collections.abc import Iterator

_HERE, _THERE = "10.231.77.1", "10.231.77.2"
_PORT = 7447
_IP = shutil.which("ip")


class CutCable:
    """A network namespace for the replay service, connected to the others by a switch.

    A cut disconnects the replay service from the switch. Both sides keep their carrier, so packets
    are lost without an error.
    """

    def __init__(self) -> None:
        tag = f"u{os.getpid()}"
        self._machine, self._switch = f"{tag}-replay", f"{tag}-switch"
        self._near, self._far = f"{tag}a", f"{tag}b"  # outer ends of the two cables
        self.listen = self.endpoint = f"tcp/{_THERE}:{_PORT}"
        self.listen_options: tuple[str, ...] = ("--insecure",)
        self.prefix: tuple[str, ...] = ("ip", "netns", "exec", self._machine)
        try:
            self._build()
        except BaseException:
            self.close()
            raise

    @staticmethod
    def is_possible() -> bool:
        """Return whether this machine supports it."""
        return os.geteuid() == 0 and _IP is not None

    @contextlib.contextmanager
    def cut(self) -> Iterator[None]:
        """Drop every packet."""
        self._in_switch("link", "set", "plug", "nomaster")
        try:
            yield
        finally:
            self._in_switch("link", "set", "plug", "master", "switch")

    def close(self) -> None:
        """Delete the namespaces, and the cables with them."""
        for name in (self._machine, self._switch):
            _ip("netns", "delete", name, check=False)

    def _build(self) -> None:
        for name in (self._machine, self._switch):
            _ip("netns", "add", name)
        switch, machine = ("netns", self._switch), ("netns", self._machine)
        _ip("link", "add", self._near, "type", "veth", "peer", "name", "others", *switch)
        _ip("link", "add", self._far, *machine, "type", "veth", "peer", "name", "plug", *switch)
        _ip("address", "add", f"{_HERE}/24", "dev", self._near)
        _ip("link", "set", self._near, "up")
        self._in_machine("address", "add", f"{_THERE}/24", "dev", self._far)
        self._in_machine("link", "set", self._far, "up")
        self._in_switch("link", "add", "switch", "type", "bridge")
        for name in ("others", "plug"):
            self._in_switch("link", "set", name, "master", "switch")
        for name in ("switch", "others", "plug"):
            self._in_switch("link", "set", name, "up")

    def _in_switch(self, *arguments: str) -> None:
        _ip("-netns", self._switch, *arguments)

    def _in_machine(self, *arguments: str) -> None:
        _ip("-netns", self._machine, *arguments)


def _ip(*arguments: str, check: bool = True) -> None:
    assert _IP is not None
    subprocess.run([_IP, *arguments], check=check, capture_output=True, text=True)
