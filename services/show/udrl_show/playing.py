"""``udrl play``: episodes to look at, in a window or a film, one step at a time."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Protocol

import msgspec

from udrl.commands import Command
from udrl.config import Config, change
from udrl.environments.making import Environment, make_environment
from udrl.errors import UnsupportedEnvironment
from udrl.evaluation import return_text
from udrl.rollout import Rollout
from udrl.streams import Purpose, stream_key
from udrl_inspect.agents import Agent
from udrl_show.film import Film, Picture

#: Pictures a second where the environment does not say how fast it is.
_USUAL_FPS = 30.0


class Screen(Protocol):
    """Where pictures are shown while an episode goes on."""

    def show(self, rollout: Rollout, picture: Picture, caption: str) -> bool:
        """Show a moment of an episode; return whether whoever watches wants to go on."""
        ...

    def close(self) -> None:
        """Show nothing any more."""
        ...


def with_seeds(commands: list[Command], first: int | None = None) -> list[Command]:
    """Return commands whose episodes follow from their seeds, so that a seed says which they are.

    Args:
        commands: of an evaluation, whose actions follow from their places in it.
        first: the first seed, one more for each that follows; None: the environments' seeds stay.
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
    """Return the environment of a run, made to be looked at.

    Raises:
        UnsupportedEnvironment: it has no pictures to show.
    """
    with closing(make_environment(config)) as env:
        if "rgb_array" not in env.metadata.get("render_modes", ()):
            raise UnsupportedEnvironment(
                f"environment {config.environment!r} has no pictures to show: it supports no "
                f"render_mode of 'rgb_array'; play without a film or window"
            )
    kwargs = config.environment_kwargs | {"render_mode": "rgb_array"}
    return make_environment(change(config, environment_kwargs=kwargs))


def fps_of(env: Environment) -> float:
    """Return how many steps a second of an environment's time has."""
    return float(env.metadata.get("render_fps") or _USUAL_FPS)


def play(
    agent: Agent,
    commands: list[Command],
    *,
    video: Path | None = None,
    open_screen: Callable[[float], Screen] | None = None,
) -> Iterator[Rollout]:
    """Carry out commands one after another and yield each episode when it is over.

    Args:
        agent: who acts.
        commands: what it is told.
        video: a film of all episodes.
        open_screen: opens what shows them meanwhile, so many pictures a second, and may end
            everything.

    Raises:
        ConfigError: the film cannot be made.
        EnvironmentFault: the environment raised an exception.
        UnsupportedEnvironment: there is nothing to look at.
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
    """Carry out one episode; return whether whoever watches saw it to its end."""
    while True:
        if film is not None or screen is not None:
            picture, said = rollout.picture(), caption(rollout)
            if film is not None:
                film.add(picture, said)
            if screen is not None and not screen.show(rollout, picture, said):
                return False
        if rollout.over:
            return True
        rollout.step()


def caption(rollout: Rollout) -> str:
    """Return what is asked for still, and what has been obtained."""
    return (
        f"step {rollout.steps}: obtained {return_text(rollout.episode_return)}; asked for "
        f"{return_text(rollout.desired_return)} more within {max(rollout.desired_horizon, 1)} steps"
    )
