"""``udrl play``: episodes shown in a window or recorded as a video."""

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Protocol

import msgspec

from udrl.commands import Command
from udrl.config import Config, change
from udrl.environments.adapter import Environment
from udrl.environments.making import make_environment
from udrl.errors import UnsupportedEnvironment
from udrl.evaluation import return_text
from udrl.rollout import Rollout
from udrl.streams import Purpose, stream_key
from udrl_inspect.agents import Agent
from udrl_show.film import Film, Picture

#: Frames per second if the environment does not declare them.
_USUAL_FPS = 30.0


class Screen(Protocol):
    """A display for the pictures of an episode."""

    def show(self, rollout: Rollout, picture: Picture, caption: str) -> bool:
        """Show a step of an episode; return False to stop playing."""
        ...

    def close(self) -> None:
        """Close the display."""
        ...


def with_seeds(commands: list[Command], first: int | None = None) -> list[Command]:
    """Return commands whose seeds also determine the actions, so that episodes can be repeated.

    Args:
        commands: the commands of an evaluation.
        first: seed of the first command; each further one adds 1. None: the commands' own seeds.
    """
    seeds = [
        command.environment_seed if first is None else (first + k) % 2**31
        for k, command in enumerate(commands)
    ]
    return [
        msgspec.structs.replace(
            command, environment_seed=seed, stream_key=stream_key(seed, Purpose.EPISODE)
        )
        for command, seed in zip(commands, seeds, strict=True)
    ]


def filmed(config: Config) -> Environment:
    """Return the environment of a run, created with rgb_array rendering.

    Raises:
        UnsupportedEnvironment: it does not support rgb_array rendering.
    """
    with closing(make_environment(config)) as env:
        modes = env.metadata.get("render_modes")
        if not (isinstance(modes, Iterable) and "rgb_array" in modes):
            raise UnsupportedEnvironment(
                f"environment {config.environment!r} has no pictures to show: it does not support "
                f"render_mode='rgb_array'; play without --video and --window"
            )
    kwargs = config.environment_kwargs | {"render_mode": "rgb_array"}
    return make_environment(change(config, environment_kwargs=kwargs))


def fps_of(env: Environment) -> float:
    """Return an environment's steps per second; the usual ones if it does not declare a number."""
    try:
        declared = float(env.metadata["render_fps"])
    except (LookupError, TypeError, ValueError):
        return _USUAL_FPS
    return declared if 0 < declared < math.inf else _USUAL_FPS


def play_episodes(
    agent: Agent,
    commands: list[Command],
    *,
    video: Path | None = None,
    open_screen: Callable[[float], Screen] | None = None,
) -> Iterator[Rollout]:
    """Run commands one after another, and yield each episode at its end.

    Args:
        agent: the agent.
        commands: its commands.
        video: file for a video of all episodes.
        open_screen: opens a display; its argument is the frames per second. The display can stop
            playing.

    Raises:
        ConfigError: the video cannot be written.
        EnvironmentFault: the environment raised an exception.
        UnsupportedEnvironment: the environment has no pictures.
    """
    looks = video is not None or open_screen is not None
    policy = agent.policy
    with ExitStack() as stack:
        make = filmed if looks else make_environment
        env = stack.enter_context(closing(make(agent.config)))
        film = stack.enter_context(closing(Film(video, fps_of(env)))) if video is not None else None
        screen = stack.enter_context(closing(open_screen(fps_of(env)))) if open_screen else None
        for command in commands:
            rollout = Rollout(policy, env, command)
            if not _watch(rollout, film, screen):
                return
            yield rollout


def _watch(rollout: Rollout, film: Film | None, screen: Screen | None) -> bool:
    """Run one episode; return whether it was shown to its end."""
    while True:
        if film is not None or screen is not None:
            picture, text = rollout.picture(), caption(rollout)
            if film is not None:
                film.add(picture, text)
            if screen is not None and not screen.show(rollout, picture, text):
                return False
        if rollout.over:
            return True
        rollout.step()


def caption(rollout: Rollout) -> str:
    """Return the text below a frame: the return so far, and the rest of the command."""
    return (
        f"step {rollout.steps}: return {return_text(rollout.episode_return)}; desired: "
        f"{return_text(rollout.desired_return)} more within {max(rollout.desired_horizon, 1)} steps"
    )
