"""Commands that read runs: play, runs, plot, completion."""

import csv
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import click
import imageio_ffmpeg
import pytest
from click.testing import CliRunner
from PIL import Image, ImageSequence
from starlette.testclient import TestClient

from udrl.commands import Command
from udrl.config import Budget
from udrl.environments.making import make_environment
from udrl.errors import ConfigError, StoreError, UdrlError
from udrl.rollout import Rollout
from udrl_board.app import make_app
from udrl_board.feed import Feed
from udrl_board.source import Directory
from udrl_inspect.agents import evaluate, evaluate_all, evaluation_commands, load_agent
from udrl_inspect.exporting import export_folder
from udrl_inspect.inspection import read_status
from udrl_inspect.run_list import find
from udrl_launch.cli import cli
from udrl_launch.settings import Fleet, Settings
from udrl_launch.training_run import run_training
from udrl_replay.progress import RunProgress
from udrl_replay.store import Store
from udrl_show import curve, pictures
from udrl_show.curve import compare
from udrl_show.playing import with_seeds
from whole_run import Cli, digests, reference, small, toy


def call(*arguments: object) -> str:
    result = CliRunner().invoke(
        cli, [str(a) for a in arguments], standalone_mode=False, catch_exceptions=False
    )
    assert result.return_value == 0
    return result.stdout


def lines(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines()]


def test_greedy_play_shows_the_episodes_of_evaluate(ended_run: Path) -> None:
    agent = load_agent(ended_run)
    commands = evaluation_commands(
        agent, episodes=4, temperature=0, desired_return=60, desired_horizon=50
    )
    counted = evaluate(agent, commands)
    played = lines(
        call("play", ended_run, "--episodes", 4, "--greedy", "--desired-return", 60,
             "--desired-horizon", 50, "--json")
    )  # fmt: skip
    assert [p["episode_return"] for p in played] == counted.returns
    expected = {"desired_return": 60.0, "desired_horizon": 50, "temperature": 0.0}
    assert all(expected.items() <= p.items() for p in played)
    assert all(
        p["length"] == p["episode_return"] for p in played
    )  # on CartPole, returns equal lengths


def test_printed_seed_reproduces_the_episode(ended_run: Path) -> None:
    played = lines(call("play", ended_run, "--episodes", 4, "--json"))
    for episode in played:
        (again,) = lines(
            call("play", ended_run, "--seed", episode["environment_seed"], "--episodes", 1,
                 "--json")
        )  # fmt: skip
        assert again == episode
    for line in call("play", ended_run, "--episodes", 4).splitlines()[1:]:
        seed = line.removeprefix("seed ").partition(":")[0]
        assert call("play", ended_run, "--seed", seed, "--episodes", 1).splitlines()[1:] == [line]


def test_seed_decides_every_action_at_any_position(ended_run: Path) -> None:
    agent = load_agent(ended_run)
    commands = evaluation_commands(agent, episodes=3)
    third = with_seeds(commands)[2]
    (alone,) = with_seeds(commands[:1], third.environment_seed)

    def actions(command: Command) -> list[int | list[int] | None]:
        with closing(make_environment(agent.config)) as env:
            rollout, taken = Rollout(agent.policy, env, command), []
            while not rollout.over:
                rollout.step()
                taken.append(rollout.action)
        return taken

    assert actions(alone) == actions(third)
    last = with_seeds(commands, 2**31 - 2)
    assert [c.environment_seed for c in last] == [2**31 - 2, 2**31 - 1, 0]
    assert last[2].stream_key == with_seeds(commands, 0)[0].stream_key


def test_batched_evaluations_equal_single_ones(ended_run: Path) -> None:
    agent = load_agent(ended_run)
    evaluations = [
        evaluation_commands(agent, episodes=n, temperature=t, desired_return=r)
        for n, t, r in ((3, None, 20.0), (1, 0.0, 80.0), (4, 0.5, 50.0))
    ]
    ended: list[None] = []
    together = evaluate_all(agent, evaluations, 3, lambda: ended.append(None))
    assert together == [evaluate(agent, commands) for commands in evaluations]
    assert [(r.desired_return, r.temperature) for r in together] == [(20, 1), (80, 0), (50, 0.5)]
    assert all(r.lengths == r.returns for r in together)  # on CartPole, returns equal lengths
    assert len(ended) == 8
    assert evaluate_all(agent, []) == []


def test_play_prints_desired_and_obtained_return(ended_run: Path) -> None:
    output = call(
        "play", ended_run, "--episodes", 1, "--desired-return", 60, "--desired-horizon", 50
    )
    assert "desired return 60.0 within 50 steps (temperature 1, weights version" in output
    assert ": return " in output


def test_seed_reproduces_episodes_and_consecutive_seeds_share_them(
    ended_run: Path,
) -> None:
    first = lines(call("play", ended_run, "--seed", 5, "--episodes", 3, "--json"))
    again = lines(call("play", ended_run, "--seed", 5, "--episodes", 3, "--json"))
    shifted = lines(call("play", ended_run, "--seed", 6, "--episodes", 2, "--json"))
    assert again == first
    assert shifted == first[1:]


@pytest.mark.parametrize("kind", ["mp4", "gif"])
def test_video_has_a_frame_for_every_moment(ended_run: Path, tmp_path: Path, kind: str) -> None:
    film = tmp_path / "films" / f"cart.{kind}"
    (episode,) = lines(call("play", ended_run, "--episodes", 1, "--json", "--video", film))
    moments = episode["length"] + 1
    if kind == "mp4":
        assert imageio_ffmpeg.count_frames_and_secs(str(film)) == (moments, moments / 50)
    else:  # every second frame: browsers do not play 50 a second
        with Image.open(film) as gif:
            assert gif.size == (600, 426)
            assert sum(1 for _ in ImageSequence.Iterator(gif)) == -(-moments // 2)
            assert gif.info["duration"] == 40


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("film.avi", "ends with .mp4 or .gif"),
        ("taken/film.gif", "choose a writable file"),
    ],
)
def test_invalid_video_is_rejected(
    ended_run: Path, tmp_path: Path, name: str, message: str
) -> None:
    (tmp_path / "taken").write_text("a file where a folder should be")
    with pytest.raises(ConfigError, match=message):
        call("play", ended_run, "--episodes", 1, "--video", tmp_path / name)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_full_disk_ends_a_video(ended_run: Path, tmp_path: Path) -> None:
    (tmp_path / "film.mp4").symlink_to("/dev/full")
    with pytest.raises(ConfigError, match="No space left on device"):
        call("play", ended_run, "--episodes", 1, "--video", tmp_path / "film.mp4")


def test_error_of_ffmpeg_is_reported_and_no_empty_video_remains(
    ended_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ffmpeg = tmp_path / "ffmpeg"
    ffmpeg.write_text("#!/bin/sh\necho 'Unknown encoder libx264' >&2\nexit 1\n")
    ffmpeg.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(ffmpeg))
    with pytest.raises(ConfigError, match="ffmpeg cannot write it: Unknown encoder libx264"):
        call("play", ended_run, "--episodes", 1, "--video", tmp_path / "film.mp4")
    assert not (tmp_path / "film.mp4").exists()


@pytest.mark.parametrize("name", ["seed:7.mp4", "-x.gif", "a film%03d.mp4"])
def test_video_may_have_any_name(ended_run: Path, tmp_path: Path, name: str) -> None:
    call("play", ended_run, "--episodes", 1, "--video", tmp_path / name)
    assert (tmp_path / name).stat().st_size > 1000


@pytest.mark.parametrize(("number", "expected"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interrupted_video_is_finished(
    number: signal.Signals,
    expected: int,
    ended_run: Path,
    tmp_path: Path,
    cli: Callable[..., Cli],
) -> None:
    film = tmp_path / "film.mp4"
    playing = cli("play", str(ended_run), "--episodes", "100000", "--video", str(film))
    stdout = playing.process.stdout
    assert stdout is not None
    while not (line := stdout.readline()).startswith("seed"):
        assert line, "play ended early"
    os.killpg(playing.process.pid, number)  # as Ctrl-C does, to ffmpeg too
    code, _, err = playing.finish()
    assert code == expected, err
    assert imageio_ffmpeg.count_frames_and_secs(film)[0] > 1


def test_wrong_extension_is_rejected_before_anything_is_loaded(tmp_path: Path) -> None:
    nowhere = tmp_path / "nowhere"
    for arguments, message in [
        (("play", nowhere, "--video", tmp_path / "film.avi"), "ends with .mp4 or .gif"),
        (("obedience", nowhere, "--output", tmp_path / "figure.jpg"), ".png, .svg or .pdf"),
        (("plot", nowhere, "--output", tmp_path / "figure.jpg"), ".png, .svg or .pdf"),
    ]:
        with pytest.raises(ConfigError, match=message):
            call(*arguments)


def test_play_requires_a_run(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="holds no run"):
        call("play", tmp_path)


def test_runs_are_listed_with_state_and_best_return(ended_run: Path) -> None:
    (summary,) = lines(call("runs", ended_run.parent, "--json"))
    status = read_status(ended_run)
    assert summary["run_dir"] == str(ended_run)
    assert summary["state"] == "ended"
    assert summary["environment"] == "CartPole-v1"
    assert summary["env_steps"] == status.env_steps
    assert status.final_evaluation is not None
    assert summary["best_return"] >= status.final_evaluation.mean
    table = call("runs", ended_run.parent).splitlines()
    assert table[0].split() == [
        "state", "environment", "seed", "env", "steps", "best", "return", "changed", "reason",
        "run",
    ]  # fmt: skip
    assert f"{summary['best_return']:.1f}" in table[1]
    assert summary["ended_because"] == "spent its budget of 3,000 env steps"
    assert summary["ended_because"] in table[1]
    assert table[1].endswith(str(ended_run))


def test_unreadable_runs_are_listed(ended_run: Path, tmp_path: Path) -> None:
    broken = tmp_path / "deep" / "broken"
    broken.mkdir(parents=True)
    (broken / "run.sqlite").write_text("not a database, but long enough to be taken for one" * 99)
    (summary,) = find(tmp_path)
    assert summary.state == "unreadable"
    assert "run.sqlite" in summary.problem


def test_invalid_budget_is_rejected_with_its_file(ended_run: Path, tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    shutil.copytree(ended_run, run_dir)
    (run_dir / "config.toml").write_text("max_env_steps = -5\n")
    with pytest.raises(ConfigError, match=r"config.toml: max_env_steps = -5: .*correct that line"):
        read_status(run_dir)


def test_no_runs_are_listed_as_none(tmp_path: Path) -> None:
    result = CliRunner().invoke(cli, ["runs", str(tmp_path)])
    assert "start one with: udrl train LunarLander-v3" in result.stderr
    with pytest.raises(ConfigError, match=r"no such directory; give the folder"):
        call("runs", tmp_path / "nowhere")


def test_several_runs_are_plotted_in_one_figure(ended_run: Path, tmp_path: Path) -> None:
    twin = tmp_path / "twin"
    twin.mkdir()
    (twin / "metrics.csv").write_bytes((ended_run / "metrics.csv").read_bytes())
    picture = tmp_path / "pictures" / "both.svg"
    assert str(picture) in call("plot", ended_run, twin, "--output", picture, "--x", "wall_s")
    drawn = ElementTree.fromstring(picture.read_text())
    # The interval of a final evaluation, which the copy without a store lacks.
    assert picture.read_text().count('id="LineCollection_') == 1
    assert "cart" in picture.read_text()
    assert drawn.tag.endswith("svg")
    with pytest.raises(ConfigError, match=r"ends with .png, .svg or .pdf"):
        compare([ended_run], tmp_path / "picture.bmp")
    with pytest.raises(StoreError, match="give the directory of a run"):
        compare([tmp_path], tmp_path / "picture.png")


def test_names_of_runs_are_drawn_as_they_are(
    ended_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [r"cost$\5$", "_hidden"]  # not a formula, and not left out of the legend
    runs = [shutil.copytree(ended_run, tmp_path / "runs" / name) for name in names]
    figures: list[Any] = []
    save = pictures.save

    def save_and_keep(figure: Any, picture: Path) -> None:
        save(figure, picture)
        figures.append(figure)

    monkeypatch.setattr(pictures, "save", save_and_keep)
    call("plot", *runs, "--output", tmp_path / "both.svg")
    drawn = [text.get_text() for text in figures[0].axes[0].get_legend().get_texts()]
    assert drawn == [f"runs/{name}" for name in names]


def test_old_final_evaluation_of_an_extended_run_keeps_its_wall_time(
    ended_run: Path, tmp_path: Path
) -> None:
    extended = tmp_path / "run"
    shutil.copytree(ended_run, extended)
    before = curve.read_curve(ended_run)
    names, *_, last = csv.reader((extended / "metrics.csv").read_text().splitlines())
    row = dict(zip(names, last, strict=True))
    row |= {"iteration": str(int(row["iteration"]) + 1), "wall_s": "6000"}
    with (extended / "metrics.csv").open("a") as file:
        file.write(",".join(row.values()) + "\n")
    assert curve.read_curve(extended).rows[-1]["wall_s"] == 6000
    final = curve._final([curve.read_curve(extended)], "wall_s")
    assert final == curve._final([before], "wall_s")
    assert final is not None
    assert final.at == before.rows[-1]["wall_s"] / 60


def test_folder_of_runs_is_plotted_as_means_over_seeds(ended_run: Path, tmp_path: Path) -> None:
    runs, figure = tmp_path / "runs", tmp_path / "all.svg"
    for seed in (7, 8):
        settings = Settings(small(seed=seed), Budget(max_env_steps=3000), Fleet(actors=1))
        run_training(settings, runs / f"cart-{seed}", threading.Event(), in_process=True)
    run_training(
        Settings(toy(), Budget(max_env_steps=200), Fleet(actors=1)),
        runs / "toy", threading.Event(), in_process=True,
    )  # fmt: skip
    assert call("plot", runs, "--output", figure) == f"figure: {figure}\n"
    drawn = figure.read_text()
    assert [name in drawn for name in ("CartPole-v1", "Figure2-v0", "2 seeds")] == [True] * 3
    assert drawn.count('id="axes_') == 2  # one panel for each environment
    assert drawn.count('id="LineCollection_') == 2  # one final evaluation in each

    lines, missing = curve._lines([runs])
    assert [len(line) for line in lines] == [2, 1]
    assert missing == []
    seeds = [[r["eval_mean"] for r in curve._evaluated(one)] for one in lines[0]]
    means = [p.mean for p in curve._points(lines[0], "env_steps")]
    assert means == [sum(pair) / 2 for pair in zip(*seeds, strict=True)]
    final = curve._final(lines[0], "env_steps")
    ends = [one.final.evaluation.mean for one in lines[0] if one.final]
    assert final is not None
    assert (final.low, final.mean, final.high) == (min(ends), sum(ends) / 2, max(ends))

    # A seed counts once: with another budget it has a line of its own.
    shorter = Settings(small(seed=7), Budget(max_env_steps=1000), Fleet(actors=1))
    run_training(shorter, runs / "cart-7-shorter", threading.Event(), in_process=True)
    lines, _ = curve._lines([runs])
    assert sorted(len(line) for line in lines) == [1, 1, 2]
    assert [one.seed for line in lines if len(line) == 2 for one in line] == [7, 8]

    # Listed individually, each run has its own line.
    call("plot", runs / "cart-7", runs / "cart-8", "--output", figure)
    assert [name in figure.read_text() for name in ("cart-7", "cart-8", "seeds")] == [
        True,
        True,
        False,
    ]

    (runs / "cart-8" / "metrics.csv").unlink()
    result = CliRunner().invoke(cli, ["plot", str(runs), "--output", str(figure)])
    assert f"not drawn: {runs / 'cart-8'}" in result.stderr


@pytest.mark.parametrize(
    "damaged",
    [b"\xff\xfe\x00", b"iteration,loss\n1,2\n", b"HEAD\n1,2\n", b"HEAD\n" + b"x," * 19 + b"x\n"],
)
def test_damaged_metrics_are_rejected(ended_run: Path, tmp_path: Path, damaged: bytes) -> None:
    head = (ended_run / "metrics.csv").read_bytes().splitlines()[0]
    (tmp_path / "metrics.csv").write_bytes(damaged.replace(b"HEAD", head))
    with pytest.raises(StoreError, match=r"metrics\.csv is damaged"):
        compare([tmp_path], tmp_path / "picture.png")


@pytest.mark.parametrize("command", ["play", "evaluate"])
def test_invalid_commands_are_rejected(command: str, ended_run: Path) -> None:
    with pytest.raises(ConfigError, match="give one of them"):
        call(command, ended_run, "--greedy", "--temperature", "0.5")
    for words in ("1e300", "nan", "-inf", "much"):
        with pytest.raises(click.BadParameter, match="is not a number from"):
            call(command, ended_run, "--desired-return", words)


def test_plot_without_data_is_rejected(ended_run: Path, tmp_path: Path) -> None:
    head = (ended_run / "metrics.csv").read_text().splitlines()[0]
    (tmp_path / "metrics.csv").write_text(head + "\n")
    with pytest.raises(StoreError, match=r"no evaluation in metrics.csv yet"):
        compare([tmp_path], tmp_path / "picture.png")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_script_is_printed(shell: str) -> None:
    assert "_UDRL_COMPLETE" in call("completion", shell)


def completed(*words: str) -> list[str]:
    """Return bash's completions of the last word."""
    given = {
        "COMP_WORDS": shlex.join(("udrl", *words[:-1])) + f" {words[-1]}",
        "COMP_CWORD": str(len(words)),
        "_UDRL_COMPLETE": "bash_complete",
    }
    done = subprocess.run(
        [sys.executable, "-m", "udrl_launch"], env=os.environ | given, capture_output=True,
        text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.stderr == ""
    return [line.removeprefix("plain,") for line in done.stdout.split()]


def test_commands_and_values_are_completed(ended_run: Path) -> None:
    assert completed("pl") == ["play", "plot"]
    landers = ["LunarLander-v3", "LunarLanderContinuous-v3", "LunarLanderSparse-v3"]
    for command in ("train", "replay", "check"):
        assert completed(command, "Lunar") == landers
    assert completed("train", "CartPole-v1", "--preset", "no") == ["none"]
    assert completed("train", "CartPole-v1", "--preset", "LunarLander-v3-p") == [
        "LunarLander-v3-paper"
    ]
    assert completed("train", "CartPole-v1", "--set", "batch") == ["batch_size="]
    assert completed("train", "CartPole-v1", "--set", "envs") == ["envs_per_actor="]
    with closing(Store(ended_run, read_only=True)) as store:
        kept = [str(version) for version in store.versions_kept()]
    assert kept
    for command in ("play", "evaluate", "obedience", "export"):
        assert completed(command, str(ended_run), "--weights", "") == ["latest", "best", *kept]
    assert completed("play", "nowhere", "--weights", "b") == ["best"]


def test_kept_versions_can_act_and_others_are_missing(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    settings = Settings(toy(lead=0), Budget(max_env_steps=400, keep_versions=1), Fleet(actors=1))
    ended = run_training(settings, run_dir, threading.Event(), in_process=True)
    assert digests(ended) == digests(reference(toy(lead=0), 400))
    with closing(Store(run_dir, read_only=True)) as store:
        evaluated = {e.iteration for e in store.evaluations(-1, 2**62)}
        best = store.fact("progress", RunProgress).best_version
    needed = {c for c in ended.weights_kept if c >= max(evaluated)}  # extends the run
    assert set(ended.weights_kept) == {best, max(evaluated)} | needed
    for version in ended.weights_kept:
        (played,) = lines(
            call("play", run_dir, "--weights", version, "--episodes", 1, "--json")
        )  # fmt: skip
        assert played["weights_version"] == version
    gone = min(evaluated - set(ended.weights_kept))
    with pytest.raises(StoreError, match=f"version {gone} is not kept in "):
        call("evaluate", run_dir, "--weights", gone)
    assert f"{len(ended.weights_kept)} versions: " in call("status", run_dir)


@pytest.fixture
def keyboard(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Any]]:
    """A window without a screen, and the keys that are pressed in it, one list for each moment."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    import pygame

    moments: list[Any] = []
    seen: list[Any] = []

    def get() -> list[Any]:
        names = moments.pop(0) if moments else []
        return [pygame.event.Event(pygame.KEYDOWN, key=pygame.key.key_code(n)) for n in names]

    monkeypatch.setattr(pygame.event, "get", get)
    monkeypatch.setattr(pygame.time, "Clock", lambda: type("Clock", (), {"tick": seen.append})())
    yield moments
    assert set(seen) == {50.0}  # the environment's own speed


def test_window_shows_an_episode(ended_run: Path, keyboard: list[Any]) -> None:
    (shown,) = lines(call("play", ended_run, "--episodes", 1, "--window", "--json"))
    (played,) = lines(call("play", ended_run, "--episodes", 1, "--json"))
    assert shown == played


def test_window_can_be_closed_during_an_episode(ended_run: Path, keyboard: list[Any]) -> None:
    keyboard += [[], ["q"]]
    assert call("play", ended_run, "--window", "--json") == ""


def test_missing_screen_is_reported(ended_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import pygame

    def init() -> None:
        raise pygame.error("No available video device")

    monkeypatch.setattr(pygame.display, "init", init)
    with pytest.raises(UdrlError, match=r"No available video device; .* --video FILE"):
        call("play", ended_run, "--window")


def test_run_directory_may_have_a_name_that_is_not_utf8(ended_run: Path, tmp_path: Path) -> None:
    odd = tmp_path / os.fsdecode(b"run-\xff")
    shutil.copytree(ended_run, odd)
    assert [one["run_dir"] for one in lines(call("runs", tmp_path, "--json"))] == [str(odd)]
    (report,) = lines(call("evaluate", odd, "--episodes", 1, "--json"))
    assert report["run_dir"] == str(odd)
    assert compare([odd], tmp_path / "curves.svg") == []
    agent = odd / os.fsdecode(b"agent-\xff")
    export_folder(load_agent(odd), odd, agent)
    assert r'udrl.load("agent-\udcff")' in (agent / "README.md").read_text()
    client = TestClient(make_app(Feed(Directory(odd))))
    assert client.get("/news").json()["place"]["run_dir"] == str(odd)
