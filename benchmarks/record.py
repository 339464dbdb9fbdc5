"""An animated picture of an agent: one episode under a command, as a GIF of grey levels.

::

    .venv/bin/python benchmarks/record.py RUN_DIR docs/results/TakeCover-v0.gif --desired-return 500

It needs Pillow, which comes with the extra ``plot``, and an environment that renders ``rgb_array``.
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import msgspec
import numpy as np
import numpy.typing as npt
from PIL import Image

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.commands import CommandSampler
from udrl.config import Config
from udrl.environments import Environment, make_environment
from udrl.numerics import use_one_thread
from udrl_launch.agents import load_agent


class Filmed(gym.Wrapper[Any, Any, Any, Any]):
    """Keeps every so many screens."""

    def __init__(self, env: Environment, every: int) -> None:
        super().__init__(env)
        self.screens: list[npt.NDArray[np.uint8]] = []
        self._every = every
        self._step = 0

    def step(self, action: Any) -> Any:
        """Advance and look."""
        if self._step % self._every == 0:
            screen = self.env.render()
            assert isinstance(screen, np.ndarray)
            self.screens.append(screen)
        self._step += 1
        return super().step(action)


def main() -> None:
    """Act and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("file", type=Path)
    parser.add_argument("--desired-return", type=float)
    parser.add_argument("--episodes", type=int, default=1, help="the first is drawn of so many")
    parser.add_argument("--seconds", type=float, default=20.0, help="of the episode's end")
    parser.add_argument("--every", type=int, default=3, help="steps between two pictures")
    parser.add_argument("--levels", type=int, default=24, help="of grey")
    options = parser.parse_args()
    use_one_thread()
    agent = load_agent(options.run_dir)
    kwargs = agent.config.environment_kwargs | {"render_mode": "rgb_array"}
    config = msgspec.structs.replace(
        agent.config, environment_kwargs=kwargs, eval_episodes=options.episodes
    )
    films: list[Filmed] = []

    def make(config: Config) -> Environment:
        films.append(Filmed(make_environment(config), options.every))
        return films[-1]

    generator = EpisodeGenerator(config, 1, make)
    sampler = CommandSampler(config, generator.spec.max_episode_steps)
    command = sampler.close(agent.iteration, agent.buffer)[-1]
    if options.desired_return is not None:
        command = msgspec.structs.replace(command, desired_return=options.desired_return)
    (episode,) = generate_episodes(generator, [command], agent.behavior)
    fps = int(films[-1].metadata["render_fps"])
    generator.close()
    last = int(options.seconds * fps / options.every)
    step = 256 // options.levels
    pictures = [Image.fromarray(s).convert("L") for s in films[-1].screens[-last:]]
    coarse = [p.point(lambda level: level // step * step) for p in pictures]
    coarse[0].save(
        options.file, save_all=True, append_images=coarse[1:],
        duration=round(1000 * options.every / fps), loop=0, optimize=True,
    )  # fmt: skip
    print(
        f"desired {command.desired_return:.0f}, obtained {episode.episode_return:.0f}, "
        f"{options.file.stat().st_size / 1e3:.0f} KB"
    )


if __name__ == "__main__":
    main()
