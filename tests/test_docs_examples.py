"""Commands, code, files and links in the documentation exist."""

import importlib
import re
import shlex
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import click
import gymnasium as gym
import pytest

import udrl.environments  # noqa: F401 - registers environments
from tests.markdown import PAGES, ROOT, Page, anchors, files, make_targets, text_of
from udrl.config import Budget, Config, parse_assignment, setting_names
from udrl.errors import UdrlError
from udrl.strategies import CommandStrategy
from udrl_experiments.protocol import TASKS, StudyPlan, parse_seeds
from udrl_launch.cli import cli
from udrl_launch.settings import Fleet, gather
from udrl_proto.session import check_endpoint

each_page = pytest.mark.parametrize("page", PAGES, ids=str)


@each_page
def test_toml_and_python_in_the_documentation_parse(page: Path) -> None:
    for language, code in Page(page).code:
        if language == "python":
            compile(code, str(page), "exec")
        if language == "toml":
            tomllib.loads(code)


def shell_commands(code: str) -> Iterator[list[str]]:
    """Yield the simple commands of a piece of shell code as words."""
    for line in code.replace("\\\n", " ").splitlines():
        words = shlex.shlex(line.removeprefix("$ "), posix=True, punctuation_chars=True)
        words.whitespace_split = True
        command: list[str] = []
        for word in [*words, ";"]:
            if set(word) <= set(";&|()"):
                if command:
                    yield command
                command = []
            elif command or not re.fullmatch(r"\w+=.*", word):  # a variable of this command
                command.append(word)


def commands_in(page: Path) -> Iterator[list[str]]:
    """Yield the commands of a page that a reader could type."""
    parts = Page(page)
    for language, code in parts.code:
        if language in ("sh", "bash", "console"):
            yield from shell_commands(code)
        elif not language:  # possibly a drawing
            for line in re.findall(r"^(?:\$ )?(?:\S*/)?(?:udrl|make) .*", code, flags=re.MULTILINE):
                yield from shell_commands(line)
    for code in parts.inline:
        if re.match(r"(\S*/)?(udrl|make) \S", code) and not re.search(r"…|\.\.\.|\[[-A-Z]", code):
            yield from shell_commands(code)


def check_udrl(words: list[str]) -> None:
    """Parse the arguments of a command ``udrl``, without running it.

    Raises:
        click.UsageError, UdrlError: the arguments are invalid.
    """
    name, *arguments = words
    if name.startswith("-"):
        assert name in ("--help", "-h", "--version"), name
        return
    command = cli.get_command(click.Context(cli), name)
    assert command is not None, name
    while isinstance(command, click.Group):
        if not arguments:
            return  # a mention of the group
        name, *arguments = arguments
        command = command.commands[name]
    if not arguments:
        return  # a mention of the command
    try:
        context = command.make_context(name, [placeholder(word) for word in arguments])
    except click.exceptions.Exit:
        return  # --help
    given = context.params
    for endpoint in (given.get("listen"), given.get("connect")):
        if endpoint is not None:
            check_endpoint(endpoint, secure=given.get("keys") is not None)
    if "side_by_side" in given:  # a study, whose callback parses more
        StudyPlan(
            given["scale"],
            parse_seeds(given["seeds"] or "1"),
            given["max_env_steps"],
            given["assignments"],
        ).config(TASKS["lander"], 1)
    elif "assignments" in given:
        settings = {name for kind in (Config, Budget, Fleet) for name in setting_names(kind)}
        options = {n: v for n, v in given.items() if n in settings}
        gather(
            given["env"],
            preset_name=given.get("preset_name"),
            options=options,
            assignments=given["assignments"],
        )
        for assignment in given["assignments"]:
            assert parse_assignment(assignment)[0] in settings
        assert given["env"] == "ENV" or ":" in given["env"] or given["env"] in gym.registry


def placeholder(word: str) -> str:
    """Return a possible value of a placeholder."""
    if word == "ENDPOINT":
        return "tcp/127.0.0.1:7447"
    if re.fullmatch(r"[A-Z]", word):
        return "1"
    return word.replace(":PORT", ":7447")


@each_page
def test_commands_in_the_documentation_are_valid(
    page: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The reader's own module, whose source is on the page.
    own = ModuleType("patient")
    monkeypatch.setattr(own, "Patient", CommandStrategy, raising=False)
    monkeypatch.setitem(sys.modules, "patient", own)
    for command in commands_in(page):
        program, *arguments = command
        program = program.rpartition("/")[2]
        shown = shlex.join(command)
        if program == "udrl" and arguments:
            try:
                check_udrl(arguments)
            except (click.UsageError, UdrlError, KeyError, AssertionError) as error:
                pytest.fail(f"{page}: {shown}: {type(error).__name__}: {error}")
        if program == "make":
            target = next((a for a in arguments if a[0] != "-" and "=" not in a), "train")
            assert target in make_targets() or "-C" in arguments, f"{page}: {shown}"


def test_commands_are_found_in_all_places() -> None:
    code = (
        "# a comment\n$ A=1 .venv/bin/udrl train \\\n  CartPole-v1 --set hidden=[8,8] && make x | y"
    )
    assert list(shell_commands(code)) == [
        [".venv/bin/udrl", "train", "CartPole-v1", "--set", "hidden=[8,8]"],
        ["make", "x"],
        ["y"],
    ]


@pytest.mark.parametrize(
    "words",
    [
        "nothing",
        "train CartPole-v1 --seeed 3",
        "train CartPole-v1 --set batchsize=3",
        "train CartPole-v1 --set batch_size=0",
        "train NoSuchLander-v9 --seed 1",
        "train CartPole-v1 --preset nope",
        "actor --envs 16",
        "actor --connect localhost",
        "status --jason",
    ],
)
def test_invalid_commands_are_found(words: str) -> None:
    with pytest.raises((click.UsageError, UdrlError, KeyError, AssertionError)):
        check_udrl(words.split())


# Links and names.


@each_page
def test_links_in_the_repository_have_a_target(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", Page(page).words):
        if re.match(r"[a-z]+:", target):
            continue  # an external link
        path, _, anchor = target.partition("#")
        there = (ROOT / page).parent / path if path else ROOT / page
        assert there.exists(), f"{page}: {target} does not exist"
        if anchor and there.suffix == ".md":
            assert anchor in anchors(there), f"{page}: {target}: this heading does not exist"


_PATH = re.compile(r"(udrl|proto|services|tests|docs|benchmarks|experiments|\.ci)(/[\w.-]+)*/?")
_DOTTED = re.compile(r"(udrl|udrl_(?:proto|actor|learner|replay|launch))(\.\w+)+")


def exists(dotted: str) -> bool:
    """Return whether a dotted name is a module, or an attribute of one."""
    module, _, rest = dotted.partition(".")
    found = importlib.import_module(module)
    for part in rest.split("."):
        module = f"{module}.{part}"
        if not hasattr(found, part):
            try:
                importlib.import_module(module)
            except ModuleNotFoundError:
                return False
        found = getattr(found, part)
    return True


@each_page
def test_code_named_in_the_documentation_exists(page: Path) -> None:
    parts = Page(page)
    modules = {path.name for path in files("*.py")} | {block.title for block in parts.blocks}
    for name in parts.inline:
        if re.search(r"/\d|NAME", name):
            continue  # a key of the protocol, or a placeholder
        if "/" in name and _PATH.fullmatch(name):
            assert (ROOT / name).exists() or (ROOT / page).parent.joinpath(name).exists(), name
        elif _DOTTED.fullmatch(name):
            assert exists(name), f"{page}: {name}"
        elif re.fullmatch(r"\w+\.py", name):
            assert name in modules, f"{page}: {name}"


def test_pages_named_in_the_code_exist() -> None:
    for path in [*files("*.py"), Path("Makefile"), Path(".ci/run")]:
        for page in re.findall(r"\b(?:docs|proto)/[\w-]+\.md\b", text_of(path)):
            assert (ROOT / page).exists(), f"{path} names {page}"
