"""The faults that ``chaos.py`` injects, one function per disturbance.

A disturbance lasts from the call of its function to its return: until stopped services continue or
a cut network is restored. A kill returns immediately.
"""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

from cut_cable import CutCable
from disturbed_run import DisturbedRun, Link
from severed_link import SeveredLink

#: Seconds of a stop or cut: more than the lease (2 s) and the timeout of a query (3 s).
OUTAGE_S = 5.0

ROLES = ("actor", "learner", "replay")


class Fault(NamedTuple):
    """A fault.

    Attributes:
        name: name for ``--faults``.
        begin: disturbance at random moments; None: the environment causes the fault.
        lose: roles of the services that lose contact.
        link: connection between the replay service and the others.
        environment: wrapper of the environment in :mod:`disturbed_environments`; None: none.
        shows_in: counter of the run that must not be zero afterwards.
        stops_the_run: whether the run must end with exit code 9 and a command to reproduce it.
    """

    name: str
    begin: Callable[[DisturbedRun], None] | None = None
    lose: Sequence[str] = ()
    link: Callable[[], Link] = SeveredLink
    environment: str | None = None
    shows_in: Literal["env_failures", "restarts"] | None = None
    stops_the_run: bool = False


def _kill(who: Sequence[str], run: DisturbedRun) -> None:
    run.send(signal.SIGKILL, *who)


def _stop(who: Sequence[str], run: DisturbedRun) -> None:
    run.send(signal.SIGSTOP, *who)
    run.pass_by(OUTAGE_S)
    run.send(signal.SIGCONT, *who)


def _stall(run: DisturbedRun) -> None:
    assert isinstance(run.link, SeveredLink)
    with run.link.stalled():
        run.pass_by(OUTAGE_S)


def _sever(run: DisturbedRun) -> None:
    assert isinstance(run.link, SeveredLink)
    with run.link.severed():
        run.pass_by(OUTAGE_S)


def _cut(run: DisturbedRun) -> None:
    assert isinstance(run.link, CutCable)
    with run.link.cut():
        run.pass_by(OUTAGE_S)


def _twins(run: DisturbedRun) -> None:
    """Start two more actors with the same name, and kill them after a while."""
    twin = [
        sys.executable,
        str(Path(__file__).with_name("twin.py")),
        run.link.endpoint,
        str(os.getpid()),
    ]
    both = [
        subprocess.Popen(twin, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for _ in range(2)
    ]
    try:
        run.pass_by(OUTAGE_S)
    finally:
        for process in both:
            process.kill()
            process.wait(5)


FAULTS = (
    *(Fault(f"kill {role}", partial(_kill, (f"{role}-1" if role == "actor" else role,)), (role,))
      for role in ROLES),
    Fault("kill all actors", partial(_kill, ("actor",)), ("actor",)),
    Fault("kill replay and learner", partial(_kill, ("replay", "learner")), ("replay", "learner")),
    *(Fault(f"stop {role}", partial(_stop, (f"{role}-1" if role == "actor" else role,)), (role,))
      for role in ROLES),
    Fault("stall network", _stall, ("actor", "learner")),
    Fault("sever network", _sever, ("actor", "learner")),
    Fault("cut network", _cut, ("actor", "learner"), link=CutCable),
    Fault("twins", _twins),
    Fault("slow actor", environment="Slow"),
    Fault("environment raises", environment="Raising", shows_in="env_failures"),
    Fault("environment returns NaN", environment="Nan", shows_in="env_failures"),
    Fault("environment hangs", environment="Hanging", shows_in="restarts"),
    Fault("command always raises", environment="AlwaysRaising", stops_the_run=True),
    Fault("command always hangs", environment="AlwaysHanging", stops_the_run=True),
)  # fmt: skip
