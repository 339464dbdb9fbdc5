"""TakeCover and the other ViZDoom scenarios."""

import builtins
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
from gymnasium.utils.env_checker import check_env

from udrl.acting import EpisodeGenerator, Failure, generate_episodes
from udrl.actions import Categorical
from udrl.commands import Command, CommandSampler
from udrl.config import Config, build, preset
from udrl.digests import episode_digest
from udrl.environments import EnvironmentSpec, make_environment, specify
from udrl.environments.doom import Doom
from udrl.errors import UnsupportedEnvironment
from udrl.spaces import Image
from udrl_inspect.checking import check_environment


def take_cover(**changes: Any) -> Config:
    return build(Config, {"environment": "TakeCover-v0", "max_episode_steps": 60} | changes)


@pytest.fixture
def doom() -> Iterator[Callable[..., Doom]]:
    opened: list[Doom] = []

    def open_one(**options: Any) -> Doom:
        opened.append(Doom(**options))
        return opened[-1]

    yield open_one
    for one in opened:
        one.close()


def engines(owner: int) -> list[int]:
    """Return the engine processes of a process, including orphans."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            command = (entry / "cmdline").read_bytes()
            parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
        except (OSError, IndexError):
            continue
        if b"+viz_instance_id" in command and parent in (owner, 1):
            found.append(int(entry.name))
    return found


def wait_until(condition: Callable[[], bool], timeout: float = 20) -> None:
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def play(env: gym.Env[Any, Any], seed: int, steps: int = 80) -> tuple[list[bytes], float]:
    """Act at random; return the observations and the return."""
    actions = np.random.default_rng(seed).integers(0, 2, steps)
    image, _ = env.reset(seed=seed)
    seen, total = [image.tobytes()], 0.0
    for action in actions:
        image, reward, terminated, truncated, _ = env.step(action)
        seen.append(image.tobytes())
        total += float(reward)
        if terminated or truncated:
            break
    return seen, total


def test_gymnasium_checker_passes(doom: Callable[..., Doom]) -> None:
    env = doom(render_mode="rgb_array")
    check_env(env, skip_render_check=True)
    screen = env.render()
    assert screen is not None
    assert screen.shape == (120, 160, 3)


def test_take_cover_is_the_papers() -> None:
    env = make_environment(Config(environment="TakeCover-v0"))
    spec = specify(env, Config(environment="TakeCover-v0"))
    assert spec.observation_space == Image(channels=1, height=32, width=32)
    assert spec.action_space == Categorical(n=2)
    assert (spec.max_episode_steps, spec.max_return) == (2100, 2100.0)
    seen, total = play(env, 7, 2200)
    assert total == len(seen) - 1, "one reward for each step, including the last"
    assert len(set(seen)) > 20, "frames must differ"
    env.close()


@pytest.mark.parametrize(("changed", "n_advised"), [({}, 0), ({"return_scale": 0.2}, 1)])
def test_only_changed_scales_of_a_preset_get_advice(changed: Any, n_advised: int) -> None:
    settings = preset("TakeCover-v0") | changed
    del settings["max_env_steps"]
    advice = check_environment(build(Config, settings)).advice
    assert sum("return_scale" in sentence for sentence in advice) == n_advised


def test_actions_are_left_and_right(doom: Callable[..., Doom]) -> None:
    env = doom()
    names = [button.name for button in env._game.get_available_buttons()]
    assert names == ["MOVE_LEFT", "MOVE_RIGHT"]

    def strafe(action: int) -> npt.NDArray[np.uint8]:
        env.reset(seed=3)
        for _ in range(10):
            image, *_ = env.step(np.int64(action))
        return image

    assert not np.array_equal(strafe(0), strafe(1))


def test_episode_is_a_function_of_its_seed(doom: Callable[..., Doom]) -> None:
    one, other = doom(), doom()
    first = play(one, 11)
    for seed in (1, 2, 3):
        play(one, seed)
    play(other, 99)
    assert play(one, 11) == first
    assert play(other, 11) == first
    assert play(other, 12) != first


def test_size_colour_and_frame_skip(doom: Callable[..., Doom]) -> None:
    env = doom(height=30, width=40, colour=True, frame_skip=4)
    image, _ = env.reset(seed=1)
    assert image.shape == (30, 40, 3)
    assert np.ptp(image.astype(int), axis=-1).max() > 10, "must not be grey"
    _, reward, *_ = env.step(np.int64(0))
    assert reward == 4.0


def test_other_scenarios_and_scenario_files(doom: Callable[..., Doom], tmp_path: Path) -> None:
    assert doom(scenario="basic").action_space == gym.spaces.Discrete(3)
    assert doom(scenario="basic").metadata["render_fps"] == 35
    assert doom(scenario="basic", frame_skip=5).metadata["render_fps"] == 7
    with pytest.raises(
        ValueError, match=r"scenario 'nowhere': neither a file nor .* one of .*basic"
    ):
        doom(scenario="nowhere")
    with pytest.raises(ValueError, match="height = 121, width = 32: expected 1 x 1 to 120 x 160"):
        doom(height=121)


@pytest.mark.parametrize("frame_skip", [0, -1, 1.5, "4", None])
def test_frame_skip_must_be_a_positive_integer(doom: Callable[..., Doom], frame_skip: Any) -> None:
    with pytest.raises(ValueError, match=r"frame_skip = .*: expected an integer, 1 or more"):
        doom(frame_skip=frame_skip)


def error_of_scenario(path: Path, content: str) -> str:
    """Return the error for a scenario file with this content; check that no engine remains."""
    path.write_text(content)
    before = set(engines(os.getpid()))
    with pytest.raises(UnsupportedEnvironment) as caught:
        make_environment(
            build(Config, {"environment": "Doom-v0", "environment_kwargs": {"scenario": str(path)}})
        )
    wait_until(lambda: set(engines(os.getpid())) <= before)
    assert str(path) in str(caught.value)
    assert "pip install" not in str(caught.value)
    return str(caught.value)


def test_missing_file_of_a_scenario_is_named(tmp_path: Path) -> None:
    content = "doom_scenario_path = nowhere.wad\navailable_buttons = { MOVE_LEFT }\n"
    message = error_of_scenario(tmp_path / "mine.cfg", content)
    assert re.search(
        r"nowhere\.wad\" does not exist.*gymnasium\.make\('Doom-v0', scenario='.*mine\.cfg'\)",
        message,
    )


def test_scenario_without_buttons_is_rejected_with_the_remedy(tmp_path: Path) -> None:
    message = error_of_scenario(tmp_path / "mine.cfg", "no { scenario\n")
    assert "it has no buttons; name at least one that ViZDoom has as available_buttons" in message


def test_engine_that_does_not_start_is_reported_with_what_it_said(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def broken(game: Any, folder: str) -> None:
        raise OSError("libopenal.so.1: cannot open shared object file")

    monkeypatch.setattr("udrl.environments.doom._start", broken)
    with pytest.raises(UnsupportedEnvironment, match=r"libopenal.*its files or its arguments") as e:
        make_environment(take_cover())
    assert "udrl[doom]" not in str(e.value)


def test_close_ends_the_engine(doom: Callable[..., Doom]) -> None:
    before = set(engines(os.getpid()))
    env = doom()
    (engine,) = set(engines(os.getpid())) - before
    env.close()
    wait_until(lambda: engine not in engines(os.getpid()))


def test_nothing_is_written_to_the_working_directory(
    doom: Callable[..., Doom], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    doom().close()
    assert list(tmp_path.iterdir()) == []


def commands(config: Config, n: int) -> list[Command]:
    spec = EnvironmentSpec(
        observation_space=Image(channels=1, height=32, width=32),
        action_space=Categorical(n=2),
        max_episode_steps=60,
    )
    return CommandSampler(config, spec).warm_up()[:n]


def test_engine_crash_costs_one_episode() -> None:
    config = take_cover()
    undisturbed = EpisodeGenerator(config, 1)
    expected = generate_episodes(undisturbed, commands(config, 1), None)
    undisturbed.close()

    before = set(engines(os.getpid()))
    generator = EpisodeGenerator(config, 1)
    (engine,) = set(engines(os.getpid())) - before
    generator.start(commands(config, 1)[0], None)
    generator.step()
    os.kill(engine, signal.SIGKILL)
    outcomes = generator.step() or generator.step()
    assert [type(o) for o in outcomes] == [Failure]
    again = generate_episodes(generator, commands(config, 1), None)
    generator.close()
    assert [episode_digest(e) for e in again] == [episode_digest(e) for e in expected]


def test_engines_end_when_their_owner_is_killed() -> None:
    shared = set(Path("/dev/shm").glob("ViZDoom*"))
    program = """
from udrl.environments.doom import Doom
both = Doom(), Doom()
print("ready", flush=True)
input()
"""
    owner = subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert owner.stdout is not None
    assert owner.stdin is not None
    assert owner.stdout.readline() == b"ready\n"
    started = set(engines(owner.pid))
    assert len(started) == 2
    owner.kill()
    owner.wait()
    owner.stdout.close()
    owner.stdin.close()
    wait_until(lambda: not started & set(engines(owner.pid)))
    wait_until(lambda: set(Path("/dev/shm").glob("ViZDoom*")) <= shared)


def test_missing_vizdoom_is_reported_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "vizdoom", None)
    with pytest.raises(UnsupportedEnvironment, match=r'pip install "udrl\[doom\]"'):
        make_environment(take_cover())
    assert make_environment(Config(environment="CartPole-v1")) is not None


def test_broken_vizdoom_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def broken(name: str, *rest: Any) -> Any:
        if name == "vizdoom":
            raise ImportError("libopenal.so.1: cannot open shared object file")
        return real(name, *rest)

    monkeypatch.delitem(sys.modules, "vizdoom", raising=False)
    monkeypatch.setattr(builtins, "__import__", broken)
    with pytest.raises(UnsupportedEnvironment, match=r"libopenal.*udrl\[doom\]"):
        make_environment(take_cover())


# Area averaging.
