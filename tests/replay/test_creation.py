"""Creating and resuming a run, and writing its configuration."""

import re
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.actions import Categorical
from udrl.commands import CommandSampler
from udrl.config import Budget, Config, build, change, flat, read_toml
from udrl.determinism import environment_digest
from udrl.environments import EnvironmentSpec
from udrl.episode import Episode
from udrl.errors import OtherConfiguration, StoreError, UnsupportedEnvironment
from udrl.graph import acting_graph
from udrl.spaces import Category
from udrl.version import __version__
from udrl_proto import PROTOCOL, key_expressions
from udrl_proto.messages import Hello
from udrl_replay import creation
from udrl_replay.arrival import Arrival
from udrl_replay.database import STORE_FILE, exists
from udrl_replay.progress import RunProgress
from udrl_replay.resuming import resume
from udrl_replay.run import StoredRun
from udrl_replay.store import Store

TOY = Config(environment="Figure2-v0", max_return=2.0)


@pytest.fixture
def created(stack: ExitStack, tmp_path: Path) -> Store:
    return stack.enter_context(closing(creation.create_run(tmp_path, TOY)))


def test_hello_of_a_new_run_is_complete(created: Store) -> None:
    hello = created.fact("hello", Hello)
    assert hello == Hello(
        protocol=PROTOCOL,
        software=__version__,
        run_id=hello.run_id,
        settings=flat(TOY),
        environment=EnvironmentSpec(
            observation_space=Category(n=4),
            action_space=Categorical(n=3),
            max_episode_steps=2,
            max_return=2.0,
        ),
        environment_digest=environment_digest(EpisodeGenerator(TOY, 1)),
        graph=acting_graph(TOY.network, hello.environment),
    )
    assert created.fact("progress", RunProgress) == RunProgress()


@pytest.mark.parametrize(("environment", "shown"), [("Pendulum-v1", True), ("CartPole-v1", False)])
def test_hello_has_the_spaces_after_automatic_settings(
    environment: str, shown: bool, tmp_path: Path
) -> None:
    config = Config(environment=environment)
    with closing(creation.create_run(tmp_path, config, automatic=["observe_time"])) as store:
        hello = store.fact("hello", Hello)
    assert hello.config.observe_time is shown
    with closing(EpisodeGenerator(hello.config, 1)) as generator:
        assert hello.environment == generator.spec
        assert hello.environment_digest == environment_digest(generator)
    assert ("time_left" in str(hello.environment.observation_space)) is shown


def test_environment_that_does_not_replay_marks_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(creation, "repeated_digest", lambda generator: "")
    with closing(creation.create_run(tmp_path, TOY)) as store:
        progress = store.fact("progress", RunProgress)
        assert not progress.exact
        hello = store.fact("hello", Hello)
        assert not hello.exact
        assert hello.environment_digest == "", "no digest to compare actors by"
    reason = "environment Figure2-v0 does not repeat an episode from its seed"
    assert progress.inexact_reason == reason
    assert reason in caplog.text


def test_unknown_environment_creates_no_run(tmp_path: Path) -> None:
    with pytest.raises(UnsupportedEnvironment, match="Nowhere-v0"):
        creation.create_run(tmp_path / "run", Config(environment="Nowhere-v0"))
    assert not exists(tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


def test_run_exists_after_its_creation(created: Store, tmp_path: Path) -> None:
    assert exists(tmp_path)
    assert not exists(tmp_path / "other")


def test_run_is_resumed_with_its_configuration(created: Store, tmp_path: Path) -> None:
    hello = created.fact("hello", Hello)
    created.close()
    with closing(resume(tmp_path, TOY)) as store:
        assert store.fact("hello", Hello) == hello


def test_other_configuration_is_rejected_with_both_values(created: Store, tmp_path: Path) -> None:
    created.close()
    other = build(
        Config, {"environment": "Figure2-v0", "max_return": 2.0, "seed": 7, "hidden": [8]}
    )
    expected = r"seed = 1, not 7; hidden = \[32, 128, 128, 128\], not \[8\]; use its configuration"
    with pytest.raises(OtherConfiguration, match=expected):
        resume(tmp_path, other)
    # The failed attempt has released the lock.
    resume(tmp_path, TOY).close()


@pytest.fixture
def _interrupted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Interrupts the creation of a run from a dataset of three episodes, after the first."""

    def dataset(config: Config, spec: EnvironmentSpec) -> tuple[Config, list[Episode]]:
        config = change(config, n_warm_up_episodes=3, dataset="toy/ours-v0")
        with closing(EpisodeGenerator(config, 1)) as generator:
            commands = CommandSampler(config, spec).warm_up()
            return config, generate_episodes(generator, commands, None)

    def accept(run: StoredRun, arrival: Arrival, now: float) -> Literal["accepted", "duplicate"]:
        if arrival.entry.id == 1:
            raise KeyboardInterrupt
        return real(run, arrival, now)

    real = StoredRun.accept
    monkeypatch.setattr(creation, "resolve_dataset", dataset)
    monkeypatch.setattr(StoredRun, "accept", accept)


@pytest.mark.usefixtures("_interrupted")
def test_run_that_cannot_store_its_dataset_is_not_created(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        creation.create_run(tmp_path / "run", TOY)
    assert not exists(tmp_path / "run")
    with closing(Store.create(tmp_path / "run", progress=RunProgress())) as store:
        assert store.commands(cancelled=False) == []


@pytest.mark.usefixtures("_interrupted")
def test_run_without_its_dataset_is_not_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Store, "delete", Store.close)  # a killed process deletes nothing
    with pytest.raises(KeyboardInterrupt):
        creation.create_run(tmp_path, TOY)
    expected = r"does not have all episodes of its dataset.*remove it and start the run again"
    with pytest.raises(StoreError, match=expected):
        resume(tmp_path, TOY)


def test_resuming_without_a_run_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=rf"holds no run \({STORE_FILE} is missing\)"):
        resume(tmp_path, TOY)


@pytest.mark.parametrize("name", ["run", "My Run.2", "-", "x" * 200, "läufe", "a" * 49 + "--b"])
def test_run_id_is_valid_in_a_key_expression(name: str, tmp_path: Path) -> None:
    with closing(creation.create_run(tmp_path / name, TOY)) as store:
        assert key_expressions.RUN_ID.fullmatch(store.fact("hello", Hello).run_id)


def test_runs_of_equal_names_have_different_ids(tmp_path: Path) -> None:
    ids = set()
    for parent in ("one", "two"):
        with closing(creation.create_run(tmp_path / parent / "run", TOY)) as store:
            ids.add(store.fact("hello", Hello).run_id)
    assert len(ids) == 2


@given(st.text(min_size=1, max_size=200), st.integers(0, 2**63 - 1))
def test_directory_name_is_plain_for_any_environment(environment: str, seed: int) -> None:
    name = creation.directory_name(Config(environment=environment, seed=seed))
    assert re.fullmatch(r"[a-z0-9][a-z0-9-]*", name)


def test_directory_name_has_environment_and_seed() -> None:
    name = creation.directory_name(Config(environment="pack.age:LunarLander-v3", seed=12))
    assert re.fullmatch(r"pack-age-lunarlander-v3-seed12-\d{8}-\d{6}", name)


def test_resumed_run_may_newly_allow_inexact_results(created: Store, tmp_path: Path) -> None:
    created.close()
    for allow_inexact in (True, False):
        with closing(resume(tmp_path, TOY, allow_inexact=allow_inexact)) as store:
            assert store.fact("hello", Hello).allow_inexact


printable = st.text(st.characters(min_codepoint=32, exclude_characters="\x7f", codec="utf-8"))
kwargs: st.SearchStrategy[dict[str, Any]] = st.dictionaries(
    printable,
    st.booleans() | st.integers(-(2**63), 2**63 - 1) | printable
    | st.floats(allow_nan=False, allow_infinity=False),
    max_size=3,
)  # fmt: skip


@given(
    environment_kwargs=kwargs,
    learning_rate=st.floats(0, 10, exclude_min=True),
    hidden=st.lists(st.integers(1, 65_536), min_size=1, max_size=4).map(tuple),
    max_return=st.none() | st.floats(allow_nan=False, allow_infinity=False),
    stop_return=st.none() | st.floats(allow_nan=False, allow_infinity=False),
)
def test_written_configuration_round_trips(
    environment_kwargs: dict[str, Any],
    learning_rate: float,
    hidden: tuple[int, ...],
    max_return: float | None,
    stop_return: float | None,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    config = build(
        Config,
        {
            "environment": 'odd "name"\\-v0',
            "environment_kwargs": environment_kwargs,
            "learning_rate": learning_rate,
            "hidden": hidden,
            "max_return": max_return,
        },
    )
    budget = Budget(max_env_steps=5, stop_return=stop_return)
    run_dir = tmp_path_factory.getbasetemp()
    creation.write_config(run_dir, config, budget)
    values = read_toml(run_dir / "config.toml")
    assert build(Budget, {n: values.pop(n) for n in Budget.__struct_fields__ if n in values}) == (
        budget
    )
    assert build(Config, values) == config
