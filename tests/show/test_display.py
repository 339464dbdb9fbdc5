"""Progress: a panel in a terminal, plain lines elsewhere."""

import io
from collections.abc import Sequence

import msgspec
import pytest
from rich.console import Console

from udrl_proto.reports import (
    AuditStatus,
    BufferStatus,
    CommandLedger,
    EpisodeLedger,
    EvaluationStatus,
    Quarantined,
    Status,
    Waiting,
)
from udrl_show.display import Display, duration, line, panel

STATUS = Status(
    run_id="run", state="running", environment="CartPole-v1", iteration=7, env_steps=12345,
    eval_env_steps=100, env_steps_per_s=9876.5, wall_s=61.0, max_env_steps=100_000,
    stop_return=None, time_left_s=3700.0,
    commands=CommandLedger(issued=1, accepted=1, cancelled=0, outstanding=0),
    episodes=EpisodeLedger(delivered=1, accepted=1, duplicate=0, rejected=0),
    buffer=BufferStatus(episodes=3, return_min=1.0, return_mean=2.0, return_max=3.0),
    weights_version=6, weights_lag=1, weights_lag_s=0.25, weights_sha256="", replay_sha256="",
    weights_kept=(2, 4, 6), loss=0.5,
    evaluation=EvaluationStatus(
        iteration=5, env_steps=10_000, mean=42.0, std=3.0, ci95_low=41.0, ci95_high=43.0,
        episodes=100,
    ),
    final_evaluation=None, exact=True, inexact_reason="", useful_concurrency=60, env_failures=0,
    actors=(), waiting=(Waiting(who="learner l", on="actors", why="iteration 7", seconds=2.5),),
    problem="", deceived=False, ended_because="", limit_reached=None, advice="",
    audit=AuditStatus(rate=0.0, agreed=0, open=0, disputed=0), quarantined=(),
)  # fmt: skip


def test_line_has_all_values() -> None:
    text = line(STATUS)
    for part in (
        "iteration 7", "12,345 of 100,000 env steps (9,876/s)",
        "evaluation mean return 42.0 ± 1.0 at 10,000 env steps",
        "replay buffer lowest return 1.0, mean 2.0, highest 3.0", "weights version 6 (lag 1)",
        "1:01:40 left", "learner l waits for actors: iteration 7 (2.5 s)",
    ):  # fmt: skip
        assert part in text


def test_remaining_time_is_an_upper_bound_with_a_stop_return() -> None:
    stopping = msgspec.structs.replace(STATUS, stop_return=200.0)
    console = Console(file=io.StringIO(), width=120)
    with console.capture() as capture:
        console.print(panel(stopping))
    for text in (line(stopping), capture.get()):
        assert "at most 1:01:40 left" in text
    assert "target         mean return 200.0 in an evaluation" in capture.get()


def test_control_sequences_are_escaped() -> None:
    hostile = "\x1b]0;owned\x07 \x9b2J\nended: all is well \u202e"
    status = msgspec.structs.replace(
        STATUS,
        run_id=hostile,
        waiting=(Waiting(who=hostile, on=hostile, why=hostile, seconds=2.0),),
        quarantined=(Quarantined(id=hostile, why=hostile),),
    )
    console = Console(file=io.StringIO(), force_terminal=True, color_system=None, width=1000)
    console.print(panel(status))
    assert isinstance(console.file, io.StringIO)
    for text in (line(status), *console.file.getvalue().splitlines()):
        assert text.isprintable(), text
    assert "\\x1b]0;owned\\x07" in line(status)


def test_line_without_values() -> None:
    empty = BufferStatus(episodes=0, return_min=None, return_mean=None, return_max=None)
    text = line(
        msgspec.structs.replace(STATUS, evaluation=None, buffer=empty, time_left_s=None, waiting=())
    )
    assert "evaluation none yet; replay buffer empty" in text
    assert "left" not in text
    assert "waits" not in text


def test_panel_lists_quarantined_actors_and_open_audits() -> None:
    watched = msgspec.structs.replace(
        STATUS,
        audit=AuditStatus(rate=0.25, agreed=31, open=4, disputed=1),
        quarantined=(Quarantined(id="actor-9", why="its episode of command 7 differs"),),
    )
    console = Console(file=io.StringIO(), width=120)
    with console.capture() as capture:
        console.print(panel(watched))
    assert "25 % of the episodes; 31 agreed; 4 open; 1 disputed" in capture.get()
    assert "actor-9: its episode of command 7 differs" in capture.get()


def test_end_of_a_run_has_its_reason() -> None:
    ended = msgspec.structs.replace(STATUS, state="ended", ended_because="reached return 100")
    console = Console(file=io.StringIO(), width=120)
    with console.capture() as capture:
        console.print(panel(ended))
    assert "reason         reached return 100" in capture.get()
    assert "env steps      12,345; 100 more in evaluations" in capture.get()
    for live in ("per second", "lag", "episodes running"):
        assert live not in capture.get()
    assert "; reached return 100" in line(ended)
    assert "reason" not in line(STATUS)


def test_panel_has_the_advice() -> None:
    console = Console(file=io.StringIO(), width=120)
    with console.capture() as capture:
        console.print(panel(msgspec.structs.replace(STATUS, advice="return_scale = 0.025: ...")))
    assert "advice         return_scale = 0.025: ..." in capture.get()


def test_small_returns_are_distinguishable() -> None:
    assert STATUS.evaluation is not None
    small = msgspec.structs.replace(
        STATUS,
        evaluation=msgspec.structs.replace(
            STATUS.evaluation, mean=0.05, ci95_low=0.0402, ci95_high=0.0598
        ),
        buffer=BufferStatus(episodes=3, return_min=0.0, return_mean=0.0123, return_max=1.0),
    )  # fmt: skip
    text = line(small)
    assert "0.050 ± 0.010 at 10,000 env steps" in text
    assert "lowest return 0.0, mean 0.0123, highest 1.0" in text


def shown(status: Status, width: int) -> list[str]:
    console = Console(file=io.StringIO(), width=width)
    with console.capture() as capture:
        console.print(panel(status))
    return [row.rstrip() for row in capture.get().splitlines()]


@pytest.mark.parametrize(
    ("kept", "text"),
    [
        ((), []),
        ((7,), ["weights kept   1 version: 7"]),
        ((2, 4, 6), ["weights kept   3 versions: 2, 4, 6"]),
        (range(10, 200, 10), ["weights kept   19 versions: 10, 20, 30, 40, … 160, 170, 180, 190"]),
    ],
)
def test_panel_lists_kept_weights(kept: Sequence[int], text: list[str]) -> None:
    status = msgspec.structs.replace(STATUS, weights_kept=tuple(kept))
    assert [row for row in shown(status, 120) if "kept" in row] == text


@pytest.mark.parametrize("width", [40, 50, 80, 120])
def test_panel_fits_its_terminal(width: int) -> None:
    lines = shown(STATUS, width)
    assert max(map(len, lines)) <= width
    assert "mean return 42.0 ± 1.0" in "\n".join(lines)


def test_number_and_label_are_on_one_line() -> None:
    assert shown(STATUS, 50) == [
        "run            run",
        "environment    CartPole-v1",
        "state          running",
        "progress       ━         12 % of 100,000 env steps",
        "env steps      12,345; 9,876 per second;",
        "               100 more in evaluations",
        "iteration      7",
        "evaluation     mean return 42.0 ± 1.0",
        "               at 10,000 env steps",
        "replay buffer  lowest return 1.0; mean 2.0;",
        "               highest 3.0",
        "weights        version 6; loss 0.500;",
        "               lag 1 version and 0.25 s",
        "weights kept   3 versions: 2, 4, 6",
        "actors         0 with 0 environments;",
        "               0 episodes running;",
        "               at most 60 at once",
        "time           1:01 elapsed; 1:01:40 left",
        "waiting        learner l for actors:",
        "               iteration 7 (2.5 s)",
    ]
    assert len(shown(STATUS, 80)) == 13  # one line each
    assert "replay buffer  lowest return 1.0; mean 2.0; highest 3.0" in shown(STATUS, 80)


def test_long_name_is_not_truncated() -> None:
    run_id = "cartpole-v1-seed7-20261130-103400-1a2b3c4d"
    text = "\n".join(shown(msgspec.structs.replace(STATUS, run_id=run_id), 50))
    assert run_id in "".join(text.split())


@pytest.mark.parametrize(
    ("steps", "percent"), [(0, 0), (99_999, 99), (100_000, 100), (120_000, 100)]
)
def test_progress_is_relative_to_the_budget(steps: int, percent: int) -> None:
    lines = shown(msgspec.structs.replace(STATUS, env_steps=steps), 80)
    (progress,) = [row for row in lines if row.startswith("progress")]
    assert progress.endswith(f" {percent} % of 100,000 env steps")
    assert ("━" * 20 in progress) == (percent == 100)


def test_pipe_gets_plain_lines_without_repetition() -> None:
    output = io.StringIO()
    with Display(Console(file=output, force_terminal=False)) as display:
        display.show(STATUS)
        display.show(STATUS)
    assert output.getvalue() == line(STATUS) + "\n"
    assert "\x1b" not in output.getvalue()


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("output", "environment"),
    [(io.StringIO(), {"FORCE_COLOR": "1"}), (Terminal(), {"TERM": "dumb"})],
)
def test_dumb_output_gets_plain_lines(output: io.StringIO, environment: dict[str, str]) -> None:
    console = Console(file=output, _environ=environment, no_color=True)
    assert console.is_terminal
    with Display(console) as display:
        display.show(STATUS)
    assert output.getvalue() == line(STATUS) + "\n"


def test_terminal_gets_a_panel() -> None:
    output = Terminal()
    with Display(Console(file=output, _environ={"TERM": "xterm"})) as display:
        display.show(STATUS)
    assert line(STATUS) not in output.getvalue()
    assert "\x1b" in output.getvalue()


def test_panel_shows_the_final_evaluation_and_names_verbatim() -> None:
    assert STATUS.evaluation is not None
    closed = msgspec.structs.replace(
        STATUS,
        final_evaluation=msgspec.structs.replace(STATUS.evaluation, mean=77.0),
        waiting=(Waiting(who="actor [/x]", on="learner", why="[bold]", seconds=2.0),),
    )
    console = Console(width=100, file=io.StringIO())
    with console.capture() as capture:
        console.print(panel(closed))
    assert "final evaluation  mean return 77.0 ± 1.0" in capture.get()
    assert "actor [/x] for learner: [bold]" in capture.get()


@pytest.mark.parametrize(("seconds", "text"), [(0, "0:00"), (59.6, "1:00"), (3661, "1:01:01")])
def test_duration(seconds: float, text: str) -> None:
    assert duration(seconds) == text
