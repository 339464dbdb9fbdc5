"""The actor service: runs commands in many environments at once until the run ends."""

import faulthandler
import logging
import os
import platform
import threading
import time

from udrl.acting import EpisodeGenerator, Failure
from udrl.config import Config
from udrl.determinism import environment_digest
from udrl.environments.adapter import Environment
from udrl.environments.making import make_environment
from udrl.episode import Episode
from udrl.errors import Interrupted
from udrl.numerics import acting_class
from udrl.version import __version__
from udrl_actor.command_fetcher import CommandFetcher
from udrl_actor.outbox import Outbox, deliver
from udrl_proto import key_expressions, verbs
from udrl_proto.messages import Hello, JoinRequest
from udrl_proto.replay_client import ReplayClient
from udrl_proto.transport import Transport

log = logging.getLogger("udrl")

#: Interval at which the watchdog is re-armed, as a fraction of its timeout. Re-arming starts a
#: thread; doing so four times a second took 2 % of an actor's time.
_REARM_PART = 0.05
#: Minimum timeout for creating an environment, and for the probe, in seconds.
_MAKING_S = 300.0


class ActorService:
    """Runs the commands that one run assigns to this actor.

    Args:
        transport: reaches the run.
        hello: the run specification.
        name: unique to this process.
        environments: number of environments to step at once.
        stop: ends the service.
        hang_s: watchdog timeout in seconds: a native thread ends the process if one step of all
            environments takes longer (creating one may always take five minutes). None: no
            watchdog.
        first_index: index of its first environment (:data:`udrl.environments.making.INDEX`).
    """

    def __init__(
        self,
        transport: Transport,
        hello: Hello,
        name: str,
        environments: int,
        stop: threading.Event,
        hang_s: float | None = None,
        first_index: int = 0,
    ) -> None:
        self._first_index = first_index
        self._transport = transport
        self._hello = hello
        self._name = name
        self._environments = environments
        self._stop = stop
        self._hang_s = hang_s

    def run(self) -> None:
        """Act until the run ends or ``stop`` is set.

        Raises:
            UnsupportedEnvironment: this machine cannot create the run's environment.
            EnvironmentFault: the environment failed in the probe, before any command was run.
            Refused: the run does not accept this actor.
            Unreachable: the replay service has not replied for too long.
        """
        config, run_id = self._hello.config, self._hello.run_id
        generator = EpisodeGenerator(config, self._environments, self._make, self._first_index)
        self._arm(_MAKING_S)  # the probe is many steps
        client = ReplayClient(self._transport, run_id, f"actor {self._name}", self._stop)
        token = None
        try:
            join = JoinRequest(
                role="actor",
                id=self._name,
                host=platform.node(),
                pid=os.getpid(),
                software=__version__,
                environments=self._environments,
                numerics_class=acting_class(self._hello.graph, generator.spec.action_space),
                environment=generator.spec,
                environment_digest=environment_digest(generator),
            )
            self._disarm()  # requests have a deadline of their own
            client.request(verbs.JOIN, join)
            log.info(
                "%s joined run %s (%s) with %d environments",
                self._name, run_id, config.environment, self._environments,
            )  # fmt: skip
            token = self._transport.declare_presence(
                key_expressions.alive(run_id, "actor", self._name)
            )
            fetcher = CommandFetcher(self._transport, self._hello, join, client, self._stop)

            def deliver_one(outcome: Episode | Failure) -> None:
                fetcher.note_acknowledged(deliver(client, join, outcome))

            outbox = Outbox(f"outbox of {self._name}", deliver_one, fetcher.fail)
            fetcher.start()
            try:
                self._act(generator, fetcher, outbox)
            finally:
                outbox.close()
        except Interrupted as interruption:
            log.info("%s", interruption)
        finally:
            self._disarm()
            if token is not None:
                token.undeclare()
            generator.close()

    def _act(self, generator: EpisodeGenerator, fetcher: CommandFetcher, outbox: Outbox) -> None:
        """Step environments; pause while as many episodes as environments await delivery."""
        self._arm()
        outcomes: list[Episode | Failure] = []
        steps = running = 0
        armed = time.monotonic()
        while not (fetcher.ended or self._stop.is_set()):
            if fetcher.error is not None:
                raise fetcher.error
            busy = running and len(outbox) < self._environments
            if outcomes or fetcher.has_assignments or not busy:
                outbox.put(outcomes)
                assignments = fetcher.take(generator.free, steps, wait_s=0.0 if busy else 0.5)
                steps = 0
                failures = [generator.start(*assignment) for assignment in assignments]
                outcomes = [f for f in failures if f is not None]
                running = len(generator.running)
            if running and len(outbox) < self._environments:
                ended = generator.step()
                steps += running
                running -= len(ended)
                outcomes += ended
            now = time.monotonic()
            if self._hang_s is not None and now - armed > self._hang_s * _REARM_PART:
                self._arm()
                armed = now
        self._disarm()
        fetcher.join(timeout=5.0)

    def _make(self, config: Config) -> Environment:
        """Create an environment, which may take longer than a step: simulators have to start."""
        self._arm(_MAKING_S)
        env = make_environment(config)
        self._arm()
        return env

    def _arm(self, at_least_s: float = 0.0) -> None:
        if self._hang_s is not None:
            seconds = max(self._hang_s * (1 + _REARM_PART), at_least_s)
            faulthandler.dump_traceback_later(seconds, exit=True)

    def _disarm(self) -> None:
        if self._hang_s is not None:
            faulthandler.cancel_dump_traceback_later()
