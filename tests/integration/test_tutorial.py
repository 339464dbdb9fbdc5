"""The commands of the tutorial give the printed output."""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.markdown import Page
from udrl_inspect.inspection import read_status

BLOCKS = Page("docs/tutorial.md").blocks

#: Parts of the output that differ between machines, and their placeholders.
_MASKS = [
    (r"(You can command|A higher desired return|This agent does not) .*", "VERDICT"),
    (r"  obeyed$|, cut by its step limit$| \(step limit reached\)$", ""),
    (r"-[0-9a-f]{8}\b", "-ID"),
    (r"-?\d[\d.,]*(?:[:e]-?\d+)*", "N"),
]


def commands(text: str) -> list[list[str]]:
    return [shlex.split(line) for line in text.replace("\\\n", " ").splitlines()]


def masked(output: str) -> list[str]:
    """Return the lines of an output with numbers and machine-dependent parts masked."""
    lines = []
    for line in output.splitlines():
        for pattern, mask in _MASKS:
            line = re.sub(pattern, mask, line)
        lines.append(" ".join(line.split()))
    return [line for line in lines if line not in ("", "...")]


def omitted_lines(printed: list[str], page: list[str]) -> list[str]:
    """Return the printed lines that the page omits; all lines of the page must be printed."""
    lines = iter(printed)
    missing = []
    for shown in page:
        for line in lines:
            if line == shown:
                break
            missing.append(line)
        else:
            raise AssertionError(f"the page has {shown!r}, which is not printed:\n{printed}")
    return [*missing, *lines]


def run_command(command: list[str], folder: Path) -> str:
    """Run one command of the page; return its output without progress lines."""
    program = {"udrl": [sys.executable, "-m", "udrl_launch"], "python": [sys.executable]}
    done = subprocess.run(
        program[command[0]] + command[1:], cwd=folder, capture_output=True, text=True, timeout=200,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, f"{shlex.join(command)}:\n{done.stdout}{done.stderr}"
    return done.stdout


def obedience(run_dir: Path) -> dict[str, Any]:
    report: dict[str, Any] = json.loads((run_dir / "obedience.json").read_text(encoding="utf-8"))
    return report


@pytest.mark.slow
@pytest.mark.timeout(400)  # Two training runs, 26 s on one core.
def test_tutorial_runs_and_has_the_printed_output(tmp_path: Path) -> None:
    printed = ""
    for language, title, text in BLOCKS:
        if title:
            (tmp_path / title).write_text(text, encoding="utf-8")
        elif language == "sh":
            for command in commands(text):
                if command[0] != "pip":
                    printed = run_command(command, tmp_path)
        else:
            differences = omitted_lines(masked(printed), masked(text))
            assert not differences or "..." in text, f"the page lacks {differences}:\n{printed}"

    first, second = (tmp_path / "runs" / name for name in ("first", "second"))
    for run_dir in (first, second):
        evaluation = read_status(run_dir).final_evaluation
        assert evaluation is not None
        assert evaluation.mean > 14  # of 16; random actions obtain 5.4
    ranges = [obedience(run_dir)["obeyed"] for run_dir in (first, second)]
    least, most = (obeyed["high"] - obeyed["low"] for obeyed in ranges)
    assert 2 < least < most
    assert most > 8


def test_page_has_files_commands_and_output() -> None:
    assert [block.title for block in BLOCKS if block.title] == ["orchard.py", "act.py"]
    assert {block.language for block in BLOCKS} == {"", "python", "sh"}


def test_missing_output_is_detected() -> None:
    table = "ended:  spent 40 env steps\n...\n  5.2  21  6.20  obeyed\n"
    shown = f"{table}You can command returns from 4 to 8 (mean absolute error 1)."
    assert masked(shown) == ["ended: spent N env steps", "N N N", "VERDICT"]
    assert masked("spent 40") != masked("spend 40")
