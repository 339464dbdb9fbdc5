"""A stage: runs an agent for one viewer, who gives it commands.

A stage is a thread that runs one episode at a time (:class:`udrl.rollout.Rollout`), at a multiple
of the environment's own speed, and handles requests between frames. With the same seed, command,
temperature and weights, the episode is that of ``udrl play --seed``.
"""

import contextlib
import io
import logging
import queue
import threading
import time
from collections.abc import Callable
from typing import Literal

from PIL import Image

from udrl.commands import Command
from udrl.environments.adapter import Adapter, Environment
from udrl.environments.making import make_environment
from udrl.errors import UdrlError, UnsupportedEnvironment
from udrl.policy import Policy
from udrl.rollout import Rollout
from udrl.streams import Purpose, stream_key
from udrl.weights import decode_behavior
from udrl_board.action_names import ActionComponent, action_components
from udrl_board.source import Source, Wanted
from udrl_board.stage_messages import (
    ChangeCommand,
    Moment,
    SetPaused,
    SetSpeed,
    StageProblem,
    StageRequest,
    StartEpisode,
    TakeStep,
)
from udrl_proto.messages import Hello
from udrl_show.film import Picture
from udrl_show.playing import filmed, fps_of

log = logging.getLogger("udrl")

#: Maximum number of waiting requests.
_MOST_REQUESTS = 64
#: Maximum frames per second; faster environments skip frames.
_FPS = 30.0
#: Quality of JPEG pictures, 1 to 100.
_QUALITY = 80

Show = Callable[[Moment | StageProblem, bytes | None], None]


class Stage(threading.Thread):
    """Handles requests until it is closed.

    Args:
        source: source of the agent's run.
        show: sends a moment and its picture (JPEG), may block until they are sent, and raises
            ``ConnectionError`` if the viewer has disconnected.
    """

    def __init__(self, source: Source, show: Show) -> None:
        super().__init__(name="stage", daemon=True)
        self._source = source
        self._show = show
        self._requests: queue.Queue[StageRequest | None] = queue.Queue(_MOST_REQUESTS)
        self._hello: Hello | None = None
        self._env: Adapter | None = None
        self._can_render = True
        self._policies: dict[int, Policy] = {}
        self._episode: StartEpisode | None = None
        self._actions: list[ActionComponent] = []
        self._version = 0
        self._rollout: Rollout | None = None
        self._is_paused = False
        self._is_changed = False
        self._speed = 1.0
        self._due = 0.0  # time of the next frame, seconds
        self._closed = threading.Event()

    @property
    def is_acting(self) -> bool:
        """Whether an episode is running and not paused."""
        rollout = self._rollout
        return rollout is not None and not rollout.over and not self._is_paused

    def request(self, request: StageRequest) -> bool:
        """Queue a request; return False if too many wait."""
        try:
            self._requests.put_nowait(request)
        except queue.Full:
            return False
        return True

    def close(self) -> None:
        """Make the thread end and close the environment; return at once."""
        self._closed.set()
        with contextlib.suppress(queue.Full):  # then the waiting requests wake the thread
            self._requests.put_nowait(None)

    def run(self) -> None:
        """Handle requests, step and show, until closed or the viewer has disconnected."""
        try:
            while (request := self._next()) is not None:
                try:
                    if request == "advance":
                        self._advance()
                    else:
                        self._handle(request)
                except UdrlError as error:
                    self._abort(str(error))
                except ConnectionError:
                    raise
                except Exception as error:
                    log.exception("an episode failed")
                    self._abort(f"{type(error).__name__}: {error}")
        except ConnectionError:
            pass  # the viewer has disconnected
        finally:
            self._discard_environment()

    def _abort(self, problem: str) -> None:
        """End the episode and discard its environment."""
        self._rollout = None
        self._discard_environment()
        self._show(StageProblem(problem=problem, is_over=True), None)

    def _discard_environment(self) -> None:
        env, self._env = self._env, None
        if env is not None:
            with contextlib.suppress(Exception):  # it may be broken
                env.close()

    def _next(self) -> StageRequest | Literal["advance"] | None:
        """Return the next request, or "advance" if there is none; None ends the stage."""
        if self._closed.is_set():
            return None
        if not self.is_acting:
            return self._requests.get()
        try:
            return self._requests.get(timeout=max(0.0, self._due - time.monotonic()))
        except queue.Empty:
            return "advance"

    def _handle(self, request: StageRequest) -> None:
        match request:
            case StartEpisode():
                self._start_episode(request)
                self._present(self._actions)
            case ChangeCommand() if self._rollout is not None:
                self._change_command(self._rollout, request)
                self._present()
            case SetPaused() if self._rollout is not None:
                self._is_paused, self._due = request.paused, time.monotonic()
                self._present()
            case TakeStep() if self._rollout is not None and not self._rollout.over:
                self._rollout.step()
                self._present()
            case SetSpeed():
                self._speed = request.speed

    def _start_episode(self, request: StartEpisode) -> None:
        self._rollout, self._is_changed, self._is_paused = None, False, request.paused
        hello = self._source.hello()
        if hello != self._hello:
            self._policies, self._hello = {}, hello
            self._discard_environment()
        policy = self._policy(self._hello, request.version)
        if self._env is None:
            self._env, self._can_render = _make(self._hello)
            self._actions = action_components(self._env)
        self._episode = request
        self._rollout = Rollout(
            policy,
            self._env,
            Command(
                id=0,
                kind="evaluate",
                desired_return=request.desired_return,
                cap=policy.spec.max_return,
                desired_horizon=max(0, request.desired_horizon),
                environment_seed=request.seed,
                stream_key=stream_key(request.seed, Purpose.EPISODE),
                weights_version=self._version,
                max_steps=self._hello.environment.max_episode_steps,
                temperature=request.temperature,
            ),
        )
        self._due = time.monotonic()

    def _change_command(self, rollout: Rollout, request: ChangeCommand) -> None:
        wanted_return, wanted_horizon = request.desired_return, request.desired_horizon
        rollout.set_command(
            rollout.desired_return if wanted_return is None else wanted_return,
            rollout.desired_horizon if wanted_horizon is None else wanted_horizon,
        )
        if request.temperature is not None:
            rollout.temperature = request.temperature
        self._is_changed = True

    def _policy(self, hello: Hello, wanted: Wanted) -> Policy:
        """Return the agent of a version; ``latest`` and ``best`` are looked up each time."""
        if wanted not in self._policies:
            found = self._source.weights(wanted)
            behavior = decode_behavior(hello.graph, found.weights)
            # Only one is kept: a viewer watches one agent at a time.
            self._policies = {found.version: Policy(behavior, hello.config, hello.environment)}
            wanted = found.version
        self._version = wanted
        return self._policies[wanted]

    def _advance(self) -> None:
        """Take the steps of one frame and show it."""
        assert self._rollout is not None
        assert self._env is not None
        fps = fps_of(self._env) * self._speed
        steps = max(1, round(fps / _FPS))
        for _ in range(steps):
            self._rollout.step()
            if self._rollout.over:
                break
        self._present()
        self._due = max(self._due, time.monotonic() - 0.5) + steps / fps

    def _present(self, actions: list[ActionComponent] | None = None) -> None:
        """Send the state of the episode and its picture to the viewer."""
        rollout, episode = self._rollout, self._episode
        assert rollout is not None
        assert episode is not None
        picture = _jpeg(rollout.picture()) if self._can_render else None
        moment = Moment(
            seed=episode.seed,
            version=self._version,
            commanded_return=episode.desired_return,
            commanded_horizon=episode.desired_horizon,
            desired_return=rollout.desired_return,
            desired_horizon=rollout.desired_horizon,
            temperature=rollout.temperature,
            step=rollout.steps,
            obtained=rollout.episode_return,
            action=rollout.action,
            probabilities=[] if rollout.over else rollout.probabilities.tolist(),
            actions=actions,
            over=rollout.over,
            truncated=rollout.truncated,
            is_changed=self._is_changed,
            paused=self._is_paused,
            picture=picture is not None,
        )
        self._show(moment, picture)


def _make(hello: Hello) -> tuple[Adapter, bool]:
    """Return an environment, and whether it can be rendered."""
    try:
        env: Environment = filmed(hello.config)
    except UnsupportedEnvironment:
        return make_environment(hello.config), False
    assert isinstance(env, Adapter)
    return env, True


def _jpeg(picture: Picture) -> bytes:
    file = io.BytesIO()
    Image.fromarray(picture).convert("RGB").save(file, "JPEG", quality=_QUALITY)
    return file.getvalue()
