"""An agent on a stage: somebody gives it orders, and watches it obey.

A stage is a thread that carries out one episode at a time (:class:`udrl.rollout.Rollout`), at the
environment's own speed, and takes orders meanwhile. With the same seed, command and weights it is
the episode that ``udrl play --seed`` shows.
"""

import contextlib
import io
import logging
import queue
import threading
import time
from collections.abc import Callable
from typing import Annotated, Literal

import msgspec
from msgspec import Meta
from PIL import Image

from udrl.commands import Command
from udrl.environments.making import Environment, make_environment
from udrl.errors import UdrlError, UnsupportedEnvironment
from udrl.policy import Policy
from udrl.rollout import Rollout
from udrl.setting_groups import Temperature
from udrl.streams import Purpose, stream_key
from udrl.weights import decode_behavior
from udrl_board.source import Source, Wanted
from udrl_proto.messages import Hello
from udrl_show.film import Picture
from udrl_show.playing import filmed, fps_of

log = logging.getLogger("udrl")

Return = Annotated[float, Meta(ge=-1e9, le=1e9)]
Horizon = Annotated[int, Meta(ge=-(2**31), le=2**31 - 1)]

#: Orders that may wait.
_MOST_ORDERS = 64
#: Frames a second that are sent at most; faster environments have some left out.
_FPS = 30.0
_QUALITY = 80


class Begin(msgspec.Struct, frozen=True, kw_only=True, tag_field="do", tag="begin"):
    """Begin an episode; one that goes on ends without a result."""

    desired_return: Return
    desired_horizon: Horizon
    seed: Annotated[int, Meta(ge=0, le=2**31 - 1)]
    temperature: Temperature = 1.0
    version: Annotated[int, Meta(ge=0, le=2**62)] | Literal["latest", "best"] = "latest"
    paused: bool = False


class Tell(msgspec.Struct, frozen=True, kw_only=True, tag_field="do", tag="tell"):
    """Ask for something else from here on; what is None stays as it is."""

    desired_return: Return | None = None
    desired_horizon: Horizon | None = None
    temperature: Temperature | None = None


class Pause(msgspec.Struct, frozen=True, kw_only=True, tag_field="do", tag="pause"):
    """Stand still, or go on."""

    paused: bool


class Step(msgspec.Struct, frozen=True, kw_only=True, tag_field="do", tag="step"):
    """Take one step while standing still."""


Order = Begin | Tell | Pause | Step


class Moment(msgspec.Struct, frozen=True, kw_only=True):
    """Where an episode is.

    Attributes:
        seed: of the episode.
        version: of the weights.
        asked_return, asked_horizon: the command that it began with.
        desired_return, desired_horizon: what is left of it.
        temperature: of the next action.
        step: steps so far.
        obtained: return so far.
        action: the last one, an index or one for each component; None before the first.
        probabilities: of the next action, component by component; empty when it is over.
        components: how many values there are of each component.
        over: whether it has ended.
        truncated: whether a time limit ended it.
        was_told: whether the command was changed on the way.
        paused: whether it stands still.
        picture: whether a picture follows.
    """

    seed: int
    version: int
    asked_return: float
    asked_horizon: int
    desired_return: float
    desired_horizon: int
    temperature: float
    step: int
    obtained: float
    action: int | list[int] | None
    probabilities: list[float]
    components: list[int]
    over: bool
    truncated: bool
    was_told: bool
    paused: bool
    picture: bool


class Trouble(msgspec.Struct, frozen=True, kw_only=True):
    """An order could not be obeyed.

    Attributes:
        problem: why not.
        is_over: whether the episode has ended with that.
    """

    problem: str
    is_over: bool = False


Show = Callable[[Moment | Trouble, bytes | None], None]


class Stage(threading.Thread):
    """Carries out orders until it is closed.

    Args:
        source: where the agent comes from.
        show: called with every moment and its picture (JPEG); may take as long as sending takes,
            and raises ``ConnectionError`` when nobody watches any more.
    """

    def __init__(self, source: Source, show: Show) -> None:
        super().__init__(name="stage", daemon=True)
        self._source = source
        self._show = show
        self._orders: queue.Queue[Order | None] = queue.Queue(_MOST_ORDERS)
        self._hello: Hello | None = None
        self._env: Environment | None = None
        self._draws = True
        self._policies: dict[int, Policy] = {}
        self._begun: Begin | None = None
        self._version = 0
        self._rollout: Rollout | None = None
        self._is_paused = False
        self._was_told = False
        self._due = 0.0
        self._closed = threading.Event()

    @property
    def is_acting(self) -> bool:
        """Whether an episode goes on."""
        rollout = self._rollout
        return rollout is not None and not rollout.over and not self._is_paused

    def order(self, order: Order) -> bool:
        """Take an order; return False if too many wait."""
        try:
            self._orders.put_nowait(order)
        except queue.Full:
            return False
        return True

    def close(self) -> None:
        """End, and close the environment; returns at once."""
        self._closed.set()
        with contextlib.suppress(queue.Full):  # then there is something to wake up for
            self._orders.put_nowait(None)

    def run(self) -> None:
        """Obey, step and show, until closed or nobody watches."""
        try:
            while (order := self._next()) is not None:
                try:
                    if order == "go on":
                        self._advance()
                    else:
                        self._obey(order)
                except UdrlError as error:
                    self._give_up(str(error))
                except ConnectionError:
                    raise
                except Exception as error:
                    log.exception("an episode failed")
                    self._give_up(f"{type(error).__name__}: {error}")
        except ConnectionError:
            pass  # nobody watches any more
        finally:
            self._forget_environment()

    def _give_up(self, problem: str) -> None:
        """End the episode, and distrust its environment."""
        self._rollout = None
        self._forget_environment()
        self._show(Trouble(problem=problem, is_over=True), None)

    def _forget_environment(self) -> None:
        env, self._env = self._env, None
        if env is not None:
            with contextlib.suppress(Exception):  # it may be broken
                env.close()

    def _next(self) -> Order | Literal["go on"] | None:
        """Return the next order; or to go on, if there is none; None: the end."""
        if self._closed.is_set():
            return None
        if not self.is_acting:
            return self._orders.get()
        try:
            return self._orders.get_nowait()
        except queue.Empty:
            return "go on"

    def _obey(self, order: Order) -> None:
        match order:
            case Begin():
                self._begin(order)
                self._present()
            case Tell() if self._rollout is not None:
                self._tell(self._rollout, order)
                self._present()
            case Pause() if self._rollout is not None:
                self._is_paused = order.paused
                self._present()
            case Step() if self._rollout is not None and not self._rollout.over:
                self._rollout.step()
                self._present()

    def _begin(self, order: Begin) -> None:
        self._rollout, self._was_told, self._is_paused = None, False, order.paused
        hello = self._source.hello()
        if hello != self._hello:
            self._policies, self._hello = {}, hello
            self._forget_environment()
        policy = self._policy(self._hello, order.version)
        if self._env is None:
            self._env, self._draws = _make(self._hello)
        self._begun = order
        self._rollout = Rollout(
            policy,
            self._env,
            Command(
                id=0,
                kind="evaluate",
                desired_return=order.desired_return,
                cap=policy.spec.max_return,
                desired_horizon=max(0, order.desired_horizon),
                environment_seed=order.seed,
                stream_key=stream_key(order.seed, Purpose.EPISODE),
                weights_version=self._version,
                max_steps=self._hello.environment.max_episode_steps,
                temperature=order.temperature,
            ),
        )
        self._due = time.monotonic()

    def _tell(self, rollout: Rollout, order: Tell) -> None:
        wanted_return, wanted_horizon = order.desired_return, order.desired_horizon
        rollout.tell(
            rollout.desired_return if wanted_return is None else wanted_return,
            rollout.desired_horizon if wanted_horizon is None else wanted_horizon,
        )
        if order.temperature is not None:
            rollout.temperature = order.temperature
        self._was_told = True

    def _policy(self, hello: Hello, wanted: Wanted) -> Policy:
        """Return the agent of a version; named ones may be another each time."""
        if wanted not in self._policies:
            found = self._source.weights(wanted)
            behavior = decode_behavior(hello.graph, found.weights)
            # One is enough: whoever looks at two looks at one after the other.
            self._policies = {found.version: Policy(behavior, hello.config, hello.environment)}
            wanted = found.version
        self._version = wanted
        return self._policies[wanted]

    def _advance(self) -> None:
        """Take the steps of one frame, and show it when it is due."""
        assert self._rollout is not None
        assert self._env is not None
        fps = fps_of(self._env)
        steps = max(1, round(fps / _FPS))
        for _ in range(steps):
            self._rollout.step()
            if self._rollout.over:
                break
        self._due = max(self._due + steps / fps, time.monotonic() - 0.5)
        time.sleep(max(0.0, self._due - time.monotonic()))
        self._present()

    def _present(self) -> None:
        rollout, begun = self._rollout, self._begun
        assert rollout is not None
        assert begun is not None
        picture = _jpeg(rollout.picture()) if self._draws else None
        moment = Moment(
            seed=begun.seed,
            version=self._version,
            asked_return=begun.desired_return,
            asked_horizon=begun.desired_horizon,
            desired_return=rollout.desired_return,
            desired_horizon=rollout.desired_horizon,
            temperature=rollout.temperature,
            step=rollout.steps,
            obtained=rollout.episode_return,
            action=rollout.action,
            probabilities=[] if rollout.over else rollout.probabilities.tolist(),
            components=list(rollout.components),
            over=rollout.over,
            truncated=rollout.truncated,
            was_told=self._was_told,
            paused=self._is_paused,
            picture=picture is not None,
        )
        self._show(moment, picture)


def _make(hello: Hello) -> tuple[Environment, bool]:
    """Return an environment, and whether it draws itself."""
    try:
        return filmed(hello.config), True
    except UnsupportedEnvironment:
        return make_environment(hello.config), False


def _jpeg(picture: Picture) -> bytes:
    file = io.BytesIO()
    Image.fromarray(picture).convert("RGB").save(file, "JPEG", quality=_QUALITY)
    return file.getvalue()
