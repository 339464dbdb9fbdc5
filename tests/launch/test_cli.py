"""The command line."""

import io
import os
import pty
import select
import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from udrl.errors import ConfigError, StoreError
from udrl_launch.cli import cli, run
from udrl_launch.output import escape_unprintable
from udrl_launch.subcommands.runs_commands import _narrow
from udrl_launch.subcommands.train_command import _options_to_repeat, train


def udrl(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "udrl_launch", *arguments],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["trian", "CartPole-v1"], "no command 'trian'; did you mean 'train'? (see udrl --help)"),
        (["bord"], "no command 'bord'; did you mean 'board'? (see udrl --help)"),
        (["xyz"], "no such command 'xyz' (see udrl --help)"),
        (["train"], "missing argument 'ENV' (see udrl train --help)"),
        (
            ["train", "X-v0", "--stop-retrun", "1"],
            "no such option '--stop-retrun'; did you mean '--stop-return'? (see udrl train --help)",
        ),
        (
            ["train", "X-v0", "--max-env-steps", "much"],
            "invalid value for '--max-env-steps': 'much': expected a number of steps from 1 to "
            "2^53, e.g. 500K, 10M, 1e6 or 250000",
        ),
        (
            ["train", "X-v0", "--set", "batchsize=2"],
            "unknown setting 'batchsize': did you mean 'batch_size'?",
        ),
    ],
)
def test_error_is_one_line_with_the_remedy(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(arguments) == 2
    assert capsys.readouterr() == ("", f"udrl: error: {message}\n")


@pytest.mark.parametrize(
    "arguments",
    [
        ["status", "{}"],
        ["train", "CartPole-v1", "--resume", "--run-dir", "{}"],
        ["runs", "{}"],
        ["plot", "{}"],
        ["play", "{}"],
        ["export", "{}", "--onnx", "agent.onnx"],
        ["keys", "create", "{}", "--if-missing"],
        ["status", "--connect", "tls/127.0.0.1:1", "--keys", "{}"],
    ],
)
def test_path_that_cannot_be_read_is_an_error(arguments: list[str], tmp_path: Path) -> None:
    """A name that is too long stands for all such paths: permissions do not apply to root."""
    impossible = str(tmp_path / ("x" * 300))
    result = CliRunner().invoke(
        cli, [a.format(impossible) for a in arguments], standalone_mode=False
    )
    assert isinstance(result.exception, ConfigError | StoreError)


def test_error_of_a_service_has_the_same_form(tmp_path: Path) -> None:
    ended = udrl(
        "train", "CartPole-v1", "--run-dir", str(tmp_path / "run"), "--listen", "tcp/127.0.0.1"
    )
    assert ended.returncode == 2
    assert ended.stderr.startswith("udrl: error: endpoint 'tcp/127.0.0.1': expected tcp/HOST:PORT")
    assert ended.stderr.count("\n") == 1


@pytest.mark.parametrize("arguments", [[], ["keys"]])
def test_group_without_a_subcommand_shows_its_help(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("Usage: ")
    assert "Commands:" in error


def in_a_terminal(columns: int, *arguments: str) -> str:
    """Return the command's output in a terminal."""
    parent, child = pty.openpty()
    environment = os.environ | {"COLUMNS": str(columns), "TERM": "dumb"}
    with subprocess.Popen(
        [sys.executable, "-m", "udrl_launch", *arguments], stdout=child, env=environment
    ) as process:
        os.close(child)
        text = b""
        while select.select([parent], [], [], 60)[0]:
            try:
                text += os.read(parent, 65536)
            except OSError:  # the command has exited
                break
        assert process.wait(60) == 0
    os.close(parent)
    return text.decode()


@pytest.mark.parametrize("columns", [50, 80])
def test_lines_wrap_at_words_in_a_terminal(columns: int) -> None:
    words = " ".join(udrl("check", "CartPole-v1").stdout.split())
    lines = in_a_terminal(columns, "check", "CartPole-v1").splitlines()
    assert max(map(len, lines[:-1])) <= columns  # the last one is a command to copy
    assert "observations  Box([-4.8 -inf " in lines[1]
    assert len(" ".join(" ".join(lines).split())) == pytest.approx(len(words), abs=40)


@pytest.mark.parametrize("columns", [50, 80])
def test_help_does_not_break_words(columns: int) -> None:
    lines = in_a_terminal(columns, "train", "--help").splitlines()
    command = "    udrl train LunarLander-v3 --max-env-steps 2M --seed 7"  # to copy
    assert max(len(line) for line in lines if line != command) <= columns
    words = " ".join(lines).split()
    assert {"LunarLander-v3,", "TakeCover-v0-paper,", "tcp/127.0.0.1:7447."} <= set(words)


def test_runs_in_a_narrow_terminal() -> None:
    row = [
        "ended", "CartPole-v1", "7", "3,000 of 3,000", "412.5", "0:12 ago",
        "spent its budget of 3,000 env steps", "runs/cartpole-v1-seed7",
    ]  # fmt: skip
    assert _narrow(row, 50) == [
        "runs/cartpole-v1-seed7",
        "  ended: spent its budget of 3,000 env steps;",
        "  CartPole-v1; seed 7; 3,000 of 3,000 env steps;",
        "  best return 412.5; changed 0:12 ago",
    ]
    unreadable = ["unreadable", "", "", "", "", "0:12 ago", "", "runs/broken"]
    assert _narrow(unreadable, 50) == ["runs/broken", "  unreadable; changed 0:12 ago"]


def test_exit_does_not_wait_for_callbacks() -> None:
    """Zenoh's threads outlive a session; an interpreter that exits before them hangs or aborts."""
    program = """
import sys, threading, click, zenoh
from udrl_launch import cli
from udrl_proto.session import listen
from udrl_launch.training_run import free_port

@click.command()
def busy():
    called = threading.Event()

    def callback(sample):
        called.set()
        while True:
            pass

    with listen(f"tcp/127.0.0.1:{free_port()}") as session:
        session.declare_subscriber("key", callback)
        session.put("key", b"")
        assert called.wait(10)
    print("worked")
    return 3

cli.cli.add_command(busy)
sys.argv = ["udrl", "busy"]
cli.main()
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=30)
    assert (ended.returncode, ended.stdout, ended.stderr) == (3, b"worked\n", b"")


def test_numpy_computes_in_one_thread() -> None:
    """More threads spin while they wait: two actors on two cores reached a fifth of their speed."""
    program = """
import os, sys, click
from udrl_launch import cli

@click.command()
def count():
    import numpy as np
    np.ones((500, 500)) @ np.ones((500, 500))
    print(len(os.listdir("/proc/self/task")))

cli.cli.add_command(count)
sys.argv = ["udrl", "count"]
cli.main()
"""
    unset = {name: value for name, value in os.environ.items() if "NUM_THREADS" not in name}
    ended = subprocess.run(
        [sys.executable, "-c", program], env=unset, capture_output=True, timeout=30
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, b"1\n", b"")


def test_resume_command_repeats_the_options_that_are_not_stored(tmp_path: Path) -> None:
    given = ["--run-dir", str(tmp_path / "run"), "--seed", "3", "--log", "tensorboard"]
    context = train.make_context("train", ["X-v0", *given, "--actors", "1", "--in-process"])
    with context:
        assert _options_to_repeat() == ["--actors", "1", "--in-process", "--log", "tensorboard"]


def test_crash_in_native_code_leaves_a_traceback() -> None:
    crash = "import faulthandler; faulthandler._sigsegv()"
    command = f"from udrl_launch import cli; cli.cli = lambda **_: exec({crash!r}); cli.main()"
    done = subprocess.run(
        [sys.executable, "-c", command], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode < 0
    assert "Fatal Python error: Segmentation fault" in done.stderr
    assert "in main" in done.stderr


def test_what_standard_output_cannot_encode_is_escaped(monkeypatch: pytest.MonkeyPatch) -> None:
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding="latin-1"))
    escape_unprintable()
    click.echo("run-\udcff: 3 ± 1, ≤ 4")
    assert written.getvalue() == b"run-\\udcff: 3 \xb1 1, \\u2264 4\n"
