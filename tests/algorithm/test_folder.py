"""An agent as a folder, and ``udrl.load``."""

import json
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch

import udrl
from udrl import folder
from udrl.config import Config, build
from udrl.environments import make_environment, specify
from udrl.errors import ConfigError, InvalidData, InvalidWeights
from udrl.graph import acting_graph
from udrl.inference import ActingFunction
from udrl.policy import Policy
from udrl.training import untrained


@pytest.fixture
def policy() -> Policy:
    config = build(Config, {"environment": "CartPole-v1", "hidden": [16, 16], "frame_stack": 2})
    env = make_environment(config)
    spec = specify(env, config)
    behavior = ActingFunction(acting_graph(config.network, spec), untrained(config, spec).weights)
    return Policy(behavior, config, spec, desired_return=120.5, desired_horizon=130)


@pytest.fixture
def written(policy: Policy, tmp_path: Path) -> Path:
    folder.save(tmp_path / "deep" / "agent", policy, "# A card\n")
    return tmp_path / "deep" / "agent"


def test_a_loaded_policy_is_the_one_that_was_saved(policy: Policy, written: Path) -> None:
    loaded = udrl.load(written)
    assert loaded.config == policy.config
    assert loaded.spec == policy.spec
    assert (loaded.desired_return, loaded.desired_horizon) == (120.5, 130)
    seen = np.linspace(-1, 1, 8)
    assert loaded.logits(seen, 50.0, 60).tolist() == policy.logits(seen, 50.0, 60).tolist()
    assert (written / "README.md").read_text() == "# A card\n"


def test_weights_are_read_by_safetensors_own_loader(policy: Policy, written: Path) -> None:
    tensors = safetensors.torch.load_file(written / "model.safetensors")
    expected = policy.behavior.weights
    assert {name: t.tolist() for name, t in tensors.items()} == {
        name: t.tolist() for name, t in expected.items()
    }


def test_a_policy_makes_the_environment_that_it_knows(policy: Policy) -> None:
    env = policy.make_environment(render_mode="rgb_array")
    observation, _ = env.reset(seed=1)
    assert observation.shape == (2, 4)
    assert policy.predict(observation, 100.0, 100) in (0, 1)
    assert isinstance(env.render(), np.ndarray)
    env.close()


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        (b"{", "export the run again"),
        (b'{"format": 2}', "missing required field"),
        (b'{"format": 2, "surplus": 2}', "export the run again"),
    ],
)
def test_descriptions_that_are_not_what_was_written(
    written: Path, changed: bytes, says: str
) -> None:
    (written / "config.json").write_bytes(changed)
    with pytest.raises(InvalidData, match=says):
        udrl.load(written)


def test_a_format_of_another_version_is_named_and_may_be_written_over(
    policy: Policy, written: Path
) -> None:
    description = json.loads((written / "config.json").read_text())
    of_another = description | {"format": 1, "surplus": 2}
    (written / "config.json").write_text(json.dumps(of_another))
    with pytest.raises(InvalidData, match="format 1, this version of udrl reads 2"):
        udrl.load(written)
    folder.save(written, policy, "# A card\n")
    assert udrl.load(written).desired_return == policy.desired_return


def test_weights_of_another_architecture(written: Path) -> None:
    description = json.loads((written / "config.json").read_text())
    description["config"]["hidden"] = [16, 32]
    (written / "config.json").write_text(json.dumps(description))
    with pytest.raises(InvalidWeights, match="another architecture"):
        udrl.load(written)


def test_no_folder(tmp_path: Path, policy: Policy) -> None:
    with pytest.raises(ConfigError, match="or a folder that udrl export --folder wrote"):
        udrl.load(tmp_path / "nothing")
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="name a folder you may write"):
        folder.save(tmp_path / "file", policy, "")


def test_the_package_offers_nothing_else() -> None:
    assert {"train", "load", "__version__"} <= set(dir(udrl))
    assert set(udrl.__all__) <= set(dir(udrl))
    with pytest.raises(AttributeError, match="'udrl' has no attribute 'loads'"):
        udrl.loads  # noqa: B018


def test_a_folder_of_others_is_left_alone(policy: Policy, written: Path, tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text("precious")
    with pytest.raises(ConfigError, match="something other than an exported agent"):
        folder.save(tmp_path, policy, "")
    assert (tmp_path / "README.md").read_text() == "precious"
    folder.save(written, policy, "# Another card\n")
    assert (written / "README.md").read_text() == "# Another card\n"
