import importlib
import sys
from collections.abc import Callable, Iterator
from functools import reduce
from itertools import count
from operator import add
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from udrl.actions import Categorical
from udrl.config import Config, build
from udrl.environments import Environment, limit_steps, make_environment, specify
from udrl.environments.figure2 import A1, A2, A3, Figure2
from udrl.environments.sparse import RewardAtEnd
from udrl.errors import EnvironmentFault, UnsupportedEnvironment
from udrl.spaces import Category, Vector


class Blank(gym.Env[Any, Any]):
    """Has the given spaces, never ends, and records its actions."""

    def __init__(self, observation: spaces.Space[Any], action: spaces.Space[Any]) -> None:
        self.metadata = {"render_modes": [], "max_return": 7.0}
        self.observation_space = observation
        self.action_space = action
        self.actions: list[Any] = []
        self.closed = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.actions.append(action)
        return self.observation_space.sample(), 1.0, False, False, {}

    def close(self) -> None:
        self.closed = True


VECTOR = spaces.Box(-1, 1, (3,), np.float32)
Register = Callable[..., str]


@pytest.fixture
def register() -> Iterator[Register]:
    """Registers a :class:`Blank` (or another factory) for the duration of the test."""
    names = (f"Blank{i}-v0" for i in count())
    registered = []

    def register_one(entry_point: Callable[..., Environment], max_steps: int | None = 10) -> str:
        name = next(names)
        gym.register(name, entry_point=entry_point, max_episode_steps=max_steps)
        registered.append(name)
        return name

    yield register_one
    for name in registered:
        del gym.registry[name]


def settings(environment: str, **others: Any) -> Config:
    return build(Config, {"environment": environment, **others})


def make(environment: str, **others: Any) -> Environment:
    return make_environment(settings(environment, **others))


def play(
    env: Environment, seed: int, actions: list[int]
) -> tuple[list[list[float]], list[float], list[bool]]:
    """Act until the episode ends; return observations, rewards and, per step, whether it ended."""
    observation, _ = env.reset(seed=seed)
    observations, rewards, ends = [observation.tolist()], [], []
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        observations.append(observation.tolist())
        rewards.append(float(reward))
        ends.append(terminated or truncated)
        if ends[-1]:
            break
    return observations, rewards, ends


def random_actions(seed: int) -> list[int]:
    return [int(a) for a in np.random.default_rng(seed).integers(4, size=1000)]


@pytest.mark.parametrize("name", ["Figure2-v0", "Obedience-v0"])
def test_toys_pass_gymnasiums_checker(name: str) -> None:
    check_env(gym.make(name).unwrapped)


@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
def test_sparse_lander_passes_gymnasiums_checker() -> None:
    # Only the wrapper is ours, hence the warning. Rendering is Gymnasium's, and needs a screen.
    check_env(gym.make("LunarLanderSparse-v3"), skip_render_check=True)


@pytest.mark.parametrize("seed", [1_000_000, 1_000_001, 1_000_002])
def test_sparse_lander_pays_the_landers_return_at_the_last_step(seed: int) -> None:
    actions = random_actions(seed)
    dense = play(make("LunarLander-v3"), seed, actions)
    sparse = play(make("LunarLanderSparse-v3"), seed, actions)
    assert sparse[0] == dense[0]
    assert sparse[1] == [0.0] * (len(dense[1]) - 1) + [reduce(add, dense[1])]
    assert sparse[2] == dense[2]
    assert dense[2][-1]


def test_sparse_lander_pays_when_the_episode_is_truncated() -> None:
    dense, sparse = make("LunarLander-v3"), make("LunarLanderSparse-v3")
    limit_steps(sparse, 20)
    _, rewards, _ = play(dense, 5, [0] * 20)
    _, (*withheld, last), ends = play(sparse, 5, [0] * 1000)
    assert ends == [False] * 19 + [True]
    assert not any(withheld)
    assert last == reduce(add, rewards)


def test_sparse_lander_discards_the_reward_of_an_abandoned_episode() -> None:
    env = make("LunarLanderSparse-v3", max_episode_steps=20)
    expected = play(env, 5, [0] * 20)
    play(env, 6, [2] * 10)
    assert play(env, 5, [0] * 20) == expected


def test_reward_at_end_records_its_arguments() -> None:
    spec = gym.make("LunarLanderSparse-v3").spec
    assert spec is not None
    assert spec.additional_wrappers == (RewardAtEnd.wrapper_spec(),)


@pytest.mark.parametrize("name", ["LunarLander-v3", "LunarLanderSparse-v3"])
def test_lander_episode_is_independent_of_earlier_episodes(name: str) -> None:
    env = make(name)
    first = play(env, 1_000_000, random_actions(1))
    play(env, 1_000_001, random_actions(2))
    assert play(env, 1_000_000, random_actions(1)) == first


def test_figure_2_has_the_transitions_of_the_paper() -> None:
    env = Figure2()
    arrows = set()
    for seed in range(10):
        for action in (A1, A2, A3):
            start, _ = env.reset(seed=seed)
            state, reward, terminated, _, _ = env.step(np.int64(action))
            arrows.add((int(start), action, reward, int(state), terminated))
    in_s0 = {(0, A1, 2.0, 1, False), (0, A2, 1.0, 2, True), (0, A3, 1.0, 2, True)}
    in_s1 = {(1, action, -1.0, 3, True) for action in (A1, A2, A3)}
    assert arrows == in_s0 | in_s1


def test_figure_2_observation_is_one_of_four_states() -> None:
    env = make("Figure2-v0")
    assert specify(env, settings("Figure2-v0")).observation_space == Category(n=4)
    assert {env.reset(seed=seed)[0] for seed in range(10)} == {0, 1}


def test_obedience_pays_one_for_action_1_and_counts_down() -> None:
    env = make("Obedience-v0", environment_kwargs={"steps": 4})
    observations, rewards, ends = play(env, 1, [1, 0, 1, 1, 1])
    assert observations == [[1.0], [0.75], [0.5], [0.25], [0.0]]
    assert rewards == [1.0, 0.0, 1.0, 1.0]
    assert ends == [False, False, False, True]


def test_spec_describes_spaces_limit_and_return() -> None:
    spec = specify(make("LunarLander-v3"), settings("LunarLander-v3"))
    assert spec.observation_space == Vector(size=8)
    assert spec.action_space == Categorical(n=4)
    assert spec.max_episode_steps == 1000
    assert spec.max_return is None


def test_max_return_is_from_setting_then_instance_then_metadata(
    register: Register,
) -> None:
    obedience, blank = "Obedience-v0", register(lambda: Blank(VECTOR, spaces.Discrete(2)))
    assert specify(make(obedience), settings(obedience, max_return=3.0)).max_return == 3.0
    assert specify(make(obedience), settings(obedience)).max_return == 8.0
    assert specify(make(blank), settings(blank)).max_return == 7.0


@pytest.mark.parametrize(
    "declared",
    [np.inf, np.float32("nan"), 10**400, "500", print, [1.0], 1j],
    ids=lambda value: str(value)[:10],
)
def test_declared_max_return_must_be_a_finite_number(register: Register, declared: Any) -> None:
    """JSON has neither infinity nor NaN: stored as null, it would differ from what actors find."""

    def factory() -> Blank:
        blank = Blank(VECTOR, spaces.Discrete(2))
        blank.metadata["max_return"] = declared
        return blank

    name = register(factory)
    with pytest.raises(
        UnsupportedEnvironment, match=r"max_return = .*expected a finite number.*--set max_return="
    ):
        specify(make(name), settings(name))
    assert specify(make(name), settings(name, max_return=3.0)).max_return == 3.0


def test_declared_max_return_may_be_any_kind_of_number(register: Register) -> None:
    def factory() -> Blank:
        blank = Blank(VECTOR, spaces.Discrete(2))
        blank.metadata["max_return"] = np.float32(2.5)
        return blank

    name = register(factory)
    assert specify(make(name), settings(name)).max_return == 2.5


def test_discrete_observation_with_offset_is_shifted_to_zero(register: Register) -> None:
    name = register(lambda: Blank(spaces.Discrete(3, start=-1), spaces.Discrete(2)))
    env = make(name)
    assert specify(env, settings(name)).observation_space == Category(n=3)
    for seed in range(10):
        observation, _ = env.reset(seed=seed)
        env.unwrapped.observation_space.seed(seed)
        state = env.unwrapped.observation_space.sample()
        assert observation == state + 1


def test_discrete_observation_of_too_many_states_is_rejected(register: Register) -> None:
    name = register(lambda: Blank(spaces.Discrete(2**20 + 1), spaces.Discrete(2)))
    with pytest.raises(UnsupportedEnvironment, match=r"1,048,577 states.*at most 1,048,576"):
        make(name)


def test_discrete_actions_with_offset_are_shifted_to_zero(register: Register) -> None:
    name = register(lambda: Blank(VECTOR, spaces.Discrete(3, start=5)))
    env = make(name)
    assert specify(env, settings(name)).action_space == Categorical(n=3)
    env.reset(seed=1)
    for action in (0, 1, 2):
        env.step(action)
    blank = env.unwrapped
    assert isinstance(blank, Blank)
    assert blank.actions == [5, 6, 7]


@pytest.mark.parametrize(
    ("observations", "actions", "message"),
    [
        (spaces.Text(4), spaces.Discrete(2), "its observation is Text"),
        (VECTOR, spaces.Box(-np.inf, np.inf, (2,)), "has no bounds"),
        (spaces.Text(4), spaces.Text(4), "its observation is Text.*also, its action is Text"),
    ],
    ids=str,
)
def test_unsupported_space_is_rejected_and_the_environment_closed(
    register: Register, observations: spaces.Space[Any], actions: spaces.Space[Any], message: str
) -> None:
    blank = Blank(observations, actions)
    with pytest.raises(UnsupportedEnvironment, match=message):
        make(register(lambda: blank))
    assert blank.closed


def test_environment_without_step_limit_is_rejected_with_the_remedy(
    register: Register,
) -> None:
    name = register(lambda: Blank(VECTOR, spaces.Discrete(2)), max_steps=None)
    with pytest.raises(UnsupportedEnvironment, match=r"--set max_episode_steps=1000"):
        make(name)


def test_step_limit_that_means_no_limit_is_rejected_with_the_remedy(register: Register) -> None:
    name = register(lambda: Blank(VECTOR, spaces.Discrete(2)), max_steps=2**63 - 1)
    with pytest.raises(UnsupportedEnvironment, match=r"at most 2,147,.*max_episode_steps=1000"):
        make(name)


def test_max_episode_steps_sets_or_replaces_the_limit(register: Register) -> None:
    endless = register(lambda: Blank(VECTOR, spaces.Discrete(2)), max_steps=None)
    limited = register(lambda: Blank(VECTOR, spaces.Discrete(2)), max_steps=10)
    for name in (endless, limited):
        env = make(name, max_episode_steps=5)
        assert specify(env, settings(name)).max_episode_steps == 5
        assert play(env, 1, [0] * 100)[2] == [False] * 4 + [True]


def test_limit_steps_changes_the_limit_of_later_episodes(register: Register) -> None:
    env = make(register(lambda: Blank(VECTOR, spaces.Discrete(2, start=1))))
    for steps in (3, 7, 10):
        limit_steps(env, steps)
        assert len(play(env, 1, [0] * 100)[1]) == steps


@pytest.mark.parametrize(("own", "set_to", "actions"), [(10, None, 3), (10, 4, 4), (2, None, 1)])
def test_limits_count_actions_if_a_wrapper_repeats_them(
    register: Register, own: int, set_to: int | None, actions: int
) -> None:
    name = register(lambda: Blank(VECTOR, spaces.Discrete(2)), max_steps=own)
    repeated = {"wrappers": ("gymnasium.wrappers:RepeatAction(num_repeats=3)",)}
    env = make(name, max_episode_steps=set_to, observe_time=True, **repeated)
    assert specify(env, settings(name, max_episode_steps=set_to)).max_episode_steps == actions
    env.reset(seed=1)
    left = [env.step(0)[0]["['time_left']"].item() for _ in range(actions)]
    assert left == pytest.approx([1 - k / actions for k in range(1, actions + 1)])
    limit_steps(env, 2)
    assert play(env, 1, [0] * 100)[2] == [False, True]


def test_wrapped_time_limit_counts_its_own_steps(register: Register) -> None:
    name = register(lambda: Blank(VECTOR, spaces.Discrete(2)), max_steps=10)
    repeat, limit = "RepeatAction(num_repeats=2)", "TimeLimit(max_episode_steps=3)"
    env = make(name, wrappers=tuple(f"gymnasium.wrappers:{w}" for w in (repeat, limit)))
    assert specify(env, settings(name)).max_episode_steps == 3
    assert play(env, 1, [0] * 100)[2] == [False, False, True]


class HidesTruncation(gym.Wrapper[Any, Any, Any, Any]):
    """Continues episodes that the step limit has ended."""

    def step(self, action: Any) -> Any:
        observation, reward, terminated, _, info = self.env.step(action)
        return observation, reward, terminated, False, info


class PassesByTheLimit(gym.Wrapper[Any, Any, Any, Any]):
    """Steps the innermost environment."""

    def step(self, action: Any) -> Any:
        return self.unwrapped.step(action)


@pytest.mark.parametrize("wrapper", [HidesTruncation, PassesByTheLimit])
def test_episode_that_does_not_end_at_its_limit_is_a_fault(
    register: Register, wrapper: type[gym.Wrapper[Any, Any, Any, Any]], importable_module: str
) -> None:
    name = register(lambda: Blank(VECTOR, spaces.Discrete(2)))
    vars(importlib.import_module(importable_module))["Wrapper"] = wrapper
    env = make(name, wrappers=(f"{importable_module}:Wrapper",))
    for limit in (10, 4):
        limit_steps(env, limit)
        env.reset(seed=1)
        for _ in range(limit - 1):
            env.step(0)
        with pytest.raises(
            EnvironmentFault, match=f"not end the episode at its step limit of {limit};"
        ):
            env.step(0)


def test_limit_steps_rejects_an_environment_without_a_limit() -> None:
    with pytest.raises(UnsupportedEnvironment, match="make it with make_environment"):
        limit_steps(Figure2(), 3)


@pytest.mark.parametrize("name", ["Pong", "NoSuchEnvironment-v0", "CartPole-v99", "a b c"])
def test_unknown_id_is_rejected_with_the_two_accepted_forms(name: str) -> None:
    with pytest.raises(
        UnsupportedEnvironment, match=f"'{name}' cannot be created.*package.module:Env-v0"
    ) as raised:
        make(name)
    assert ".;" not in str(raised.value)


@pytest.mark.parametrize(
    ("name", "module"),
    [
        ("orchard.py:Orchard-v0", "orchard:Orchard-v0"),
        ("./orchard:Orchard-v0", "orchard:Orchard-v0"),
        ("/srv/orchard.py:Orchard-v0", "orchard:Orchard-v0"),
        ("orchard.py", "orchard:Env-v0"),
    ],
)
def test_file_of_a_module_is_rejected_with_the_remedy(name: str, module: str) -> None:
    with pytest.raises(UnsupportedEnvironment, match=f"as in an import, not its file: {module},"):
        make(name)


def test_missing_module_is_rejected_with_the_remedy() -> None:
    with pytest.raises(UnsupportedEnvironment, match=r"no_such_module.*install the package"):
        make("no_such_module:Env-v0")


def test_missing_extra_is_reported_with_the_install_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def without_box2d(name: str, **_: Any) -> None:
        raise gym.error.DependencyNotInstalled("Box2D is not installed")

    monkeypatch.setattr(gym, "make", without_box2d)
    with pytest.raises(UnsupportedEnvironment, match=r'pip install "udrl\[box2d\]"'):
        make("LunarLander-v3")


def test_keyword_arguments_reach_the_environment_and_unknown_ones_are_rejected() -> None:
    env = make("Obedience-v0", environment_kwargs={"steps": 3})
    assert specify(env, settings("Obedience-v0")).max_return == 3.0
    with pytest.raises(UnsupportedEnvironment, match=r"'Obedience-v0' cannot be created.*stpes"):
        make("Obedience-v0", environment_kwargs={"stpes": 3})


def test_any_error_of_the_factory_is_a_config_error() -> None:
    with pytest.raises(UnsupportedEnvironment, match=r"AssertionError: gravity \(current value: 5"):
        make("LunarLander-v3", environment_kwargs={"gravity": 5.0})


def exits(**kwargs: Any) -> Environment:
    """Fail as an environment that checks a licence, and ends the process if there is none."""
    sys.exit("no licence")


def test_environment_that_exits_is_a_config_error(register: Register) -> None:
    with pytest.raises(UnsupportedEnvironment, match=r"cannot be created: SystemExit: no licence"):
        make(register(exits))
    with pytest.raises(UnsupportedEnvironment, match=r"cannot be applied: SystemExit: no licence"):
        make("CartPole-v1", wrappers=[f"{__name__}:exits_around"])


@pytest.mark.parametrize(
    ("wrapper", "message"),
    [
        ("no_such_module:Wrapper", "name a wrapper that is importable here"),
        ("gymnasium.wrappers:NoSuchWrapper", "name a wrapper that is importable here"),
        ("gymnasium.wrappers:TimeLimit(steps=3)", r"argument 'steps'; correct its arguments"),
        ("gymnasium.wrappers:TimeLimit", r"'max_episode_steps'; correct its arguments"),
    ],
)
def test_wrapper_that_cannot_be_applied_is_rejected_with_the_remedy(
    wrapper: str, message: str
) -> None:
    with pytest.raises(UnsupportedEnvironment, match=message):
        make("CartPole-v1", wrappers=[wrapper])


def test_wrapper_that_is_no_wrapper_is_rejected_with_the_remedy() -> None:
    with pytest.raises(
        UnsupportedEnvironment, match=r"'builtins:id' returned \d+ \(int\), expected a .*; derive"
    ):
        make("CartPole-v1", wrappers=["builtins:id"])


def exits_around(env: Environment) -> Environment:
    sys.exit("no licence")


MODULE = """
import gymnasium
from udrl.environments.obedience import Obedience

class Patience(Obedience):
    pass

gymnasium.register("Patience-v0", entry_point=Patience, max_episode_steps=5)
"""


@pytest.fixture
def importable_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The name of an importable module that registers ``Patience-v0``."""
    name = "worlds_of_a_user"
    (tmp_path / f"{name}.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    yield name
    sys.modules.pop(name, None)
    gym.registry.pop("Patience-v0", None)


def test_version_is_required_in_a_module_too(importable_module: str) -> None:
    with pytest.raises(
        UnsupportedEnvironment, match=f"did you mean '{importable_module}:Patience-v0'"
    ):
        make(f"{importable_module}:Patience")


class Bare(gym.Env[Any, Any]):
    """Has no spaces."""

    def __init__(self, lacks: str, closed: list[str]) -> None:
        self.lacks, self.closed = lacks, closed
        for space in {"observation_space", "action_space"} - {lacks}:
            setattr(self, space, spaces.Discrete(2))

    def close(self) -> None:
        self.closed.append(self.lacks)


@pytest.mark.parametrize("lacks", ["observation_space", "action_space"])
def test_environment_without_a_space_is_rejected_and_closed(register: Register, lacks: str) -> None:
    closed: list[str] = []
    name = register(lambda: Bare(lacks, closed))
    with pytest.raises(
        UnsupportedEnvironment, match=f"has no {lacks}; set self.{lacks} to a space"
    ):
        make(name, observe_time=True)
    assert closed == [lacks]


def test_importable_environment_is_imported(importable_module: str) -> None:
    env = make(f"{importable_module}:Patience-v0")
    assert type(env.unwrapped).__name__ == "Patience"
    assert specify(env, settings(f"{importable_module}:Patience-v0")).max_episode_steps == 5


def test_module_that_fails_to_import_is_rejected(importable_module: str, tmp_path: Path) -> None:
    (tmp_path / f"{importable_module}.py").write_text("from gymnasium import no_such_name")
    with pytest.raises(UnsupportedEnvironment, match="cannot import name 'no_such_name'"):
        make(f"{importable_module}:Patience-v0")


def test_unknown_environment_of_an_importable_module_is_rejected(importable_module: str) -> None:
    with pytest.raises(
        UnsupportedEnvironment,
        match=rf"'{importable_module}:Impatience-v0' cannot be created.*"
        rf"gymnasium\.register\('Impatience-v0', ...\) in {importable_module}",
    ):
        make(f"{importable_module}:Impatience-v0")
