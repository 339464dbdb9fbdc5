"""The behaviour described in the pages on operations is the actual one."""

import re
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from tests.markdown import PAGES, Page, codes, files, records, section, text_of
from udrl.config import Budget, Config
from udrl.errors import OtherConfiguration
from udrl_actor import outbox
from udrl_inspect.inspection import budget_of
from udrl_launch import supervisor
from udrl_launch.roles import open_run
from udrl_launch.settings import Fleet, Settings
from udrl_launch.subcommands.settings_options import gather_settings
from udrl_proto import replay_client, verbs
from udrl_proto.access import RIGHTS
from udrl_proto.messages import Hello
from udrl_replay import auditing, dispatching, quarantine, replay_service
from udrl_replay.schema import SCHEMA
from udrl_replay.store import Store

OPERATIONS = "docs/operations.md"
TOY = Config(environment="Figure2-v0", max_return=2.0)

# Resuming.


def resume_settings(run_dir: Path, *, allow_inexact: bool = False, **given: Any) -> Settings:
    """Resume a run with options of ``udrl train``; return the resulting settings."""
    nothing = {"preset_name": None, "file": None, "assignments": ()}
    settings = gather_settings(TOY.environment, nothing | given, run_dir, resume=True)
    open_run(
        run_dir, settings, resume=True, allow_inexact=allow_inexact, listen=None,
        insecure=False, secure=False,
    ).close()  # fmt: skip
    return settings


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    """The directory of a run with a budget of 5000 steps and a later edited configuration file."""
    settings = Settings(TOY, Budget(max_env_steps=5000), Fleet(actors=7))
    open_run(
        tmp_path, settings, resume=False, allow_inexact=False, listen=None,
        insecure=False, secure=False,
    ).close()  # fmt: skip
    file = tmp_path / "config.toml"
    text = file.read_text()
    edited = text.replace("seed = 1\n", "seed = 9\n").replace("= 5000", "= 6000")
    assert edited.count("seed = 9") == edited.count("max_env_steps = 6000") == 1
    file.write_text(edited)
    return tmp_path


def test_sources_of_settings_on_resume_are_documented() -> None:
    rows = records(section(OPERATIONS, "## Resuming and extending"), "what")
    found = {row[0].split(":")[0]: row[1] for row in rows}
    assert found == {
        "settings of [`Config`](configuration.md)": "the store",
        "the budget": "`config.toml` in the run directory",
        "`--allow-inexact`": "the store",
        "`actors`, `envs_per_actor`, `hang_timeout`, and all other options": "nowhere",
    }
    assert set(codes(rows[1][0])) == set(Budget.__struct_fields__)
    assert set(codes(rows[3][0])) == set(Fleet.__struct_fields__)


def test_resuming_takes_settings_from_the_store(run_dir: Path) -> None:
    assert resume_settings(run_dir).config.seed == TOY.seed
    with pytest.raises(OtherConfiguration) as refusal:
        resume_settings(run_dir, seed=9)
    row = records(section(OPERATIONS, "## Resuming and extending"), "what")[0]
    assert f"refused with exit code {refusal.value.exit_code}" in row[2]


def test_resuming_takes_the_budget_from_the_file(run_dir: Path) -> None:
    assert resume_settings(run_dir).budget.max_env_steps == 6000
    assert resume_settings(run_dir, max_env_steps=8000).budget.max_env_steps == 8000
    assert budget_of(run_dir).max_env_steps == 8000  # the edited value
    (run_dir / "config.toml").unlink()
    assert f"budget is the default, {Budget().max_env_steps:,} env steps" in plain(OPERATIONS)
    assert resume_settings(run_dir).budget == Budget()


def test_resuming_uses_no_earlier_fleet_settings(run_dir: Path) -> None:
    assert resume_settings(run_dir).fleet == Fleet()


def test_resuming_can_allow_inexact_results_but_not_forbid_them(run_dir: Path) -> None:
    allowed = []
    for allow_inexact in (False, True, False):
        resume_settings(run_dir, allow_inexact=allow_inexact)
        with closing(Store(run_dir, read_only=True)) as store:
            allowed.append(store.fact("hello", Hello).allow_inexact)
    assert allowed == [False, True, True]


# The protocol.


def test_message_flow_diagram_matches_the_rights_of_each_role() -> None:
    drawn: dict[str, set[str]] = {role: set() for role in RIGHTS}
    publishes: dict[str, set[str]] = {role: set() for role in RIGHTS}
    joins = set()
    lines = re.findall(
        r"^    (\w+) +-+ (.+?) -+> +(\w+)$",
        section("docs/protocol.md", "## Message flow"),
        flags=re.MULTILINE,
    )
    for sender, what, receiver in lines:
        if what == "liveliness token":
            joins.add(sender)
        elif what.endswith(", published"):
            name = what.removesuffix(", published")
            assert name in RIGHTS[receiver].subscribes
            if sender in publishes:
                publishes[sender].add(name)
        else:
            assert receiver == "replay"
            drawn[sender] |= set(what.split(", "))
    assert drawn == {role: set(verbs.sent_by(role)) for role in RIGHTS}
    assert publishes == {role: set(rights.publishes) for role, rights in RIGHTS.items()}
    assert joins == {role for role, rights in RIGHTS.items() if rights.joins}


def test_every_verb_is_documented_as_repeatable() -> None:
    rows = records(section("docs/protocol.md", "## Why queries"), "request")
    assert sorted(verb for row in rows for verb in codes(row[0])) == sorted(
        verb.name for verb in verbs.VERBS
    )


# Numbers and places.

WORDS = {5: "five", 6: "six", 8: "eight", 10: "ten"}


def plain(page: str) -> str:
    return " ".join(text_of(page).split())


@pytest.mark.parametrize(
    ("page", "phrase"),
    [
        (OPERATIONS, f"reads stores of schema {SCHEMA}."),
        (OPERATIONS, f"retries for {replay_client.PATIENCE_S:.0f} s"),
        (OPERATIONS, f"has died {WORDS[supervisor._MOST_DEATHS]} times without progress"),
        (OPERATIONS, f"At most {auditing.MOST_OPEN} audits are open"),
        (OPERATIONS, f"or {WORDS[quarantine.OFFENCES]} episodes that were malformed"),
        (
            "docs/operations-reference.md",
            f"died {WORDS[supervisor._MOST_DEATHS]} times without progress",
        ),
        ("docs/protocol.md", f"sends nothing for {dispatching.SILENCE_S:.0f} s"),
        ("docs/protocol.md", f"{dispatching.MOST_ACTORS:,} actors have joined"),
        ("docs/protocol.md", f"exit code 7 after {WORDS[replay_client._JOINS]} times"),
        (
            "docs/protocol.md",
            f"{replay_service._INBOX:,} requests and {replay_service._INBOX_BYTES >> 20} MiB",
        ),
        (
            "proto/README.md",
            f"has up to {WORDS[outbox._THREADS]} `episode` or `failure` requests in flight",
        ),
        ("proto/README.md", f"sends nothing for {dispatching.SILENCE_S:.0f} s"),
        ("proto/README.md", f"{dispatching.MOST_ACTORS:,} actors have joined"),
    ],
)
def test_numbers_in_pages_match_the_code(page: str, phrase: str) -> None:
    assert phrase in plain(page)


def test_constants_are_in_the_documented_places() -> None:
    named = [
        (page, name, place)
        for page in PAGES
        for name, place in re.findall(r"`([A-Z][A-Z_]+)`\s+in\s+`([\w/.]+\.py)`", Page(page).prose)
    ]
    assert {name for _, name, _ in named} >= {"SCHEMA", "PROTOCOL"}
    for page, name, place in named:
        found = [path for path in files("*.py") if path.as_posix().endswith(place)]
        assert found, f"{page}: {place}"
        defined = any(re.search(rf"^{name}\b.* = ", text_of(p), re.MULTILINE) for p in found)
        assert defined, f"{page}: {name} is not in {place}"
