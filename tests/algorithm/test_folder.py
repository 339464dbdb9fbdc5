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
def saved(policy: Policy, tmp_path: Path) -> Path:
    folder.save_folder(tmp_path / "deep" / "agent", policy, "# A card\n")
    return tmp_path / "deep" / "agent"


def test_loaded_policy_equals_the_saved_one(policy: Policy, saved: Path) -> None:
    loaded = udrl.load(saved)
    assert loaded.config == policy.config
    assert loaded.spec == policy.spec
    assert (loaded.desired_return, loaded.desired_horizon) == (120.5, 130)
    seen = np.linspace(-1, 1, 8)
    assert loaded.logits(seen, 50.0, 60).tolist() == policy.logits(seen, 50.0, 60).tolist()
    assert (saved / "README.md").read_text() == "# A card\n"


def test_weights_are_readable_by_safetensors(policy: Policy, saved: Path) -> None:
    tensors = safetensors.torch.load_file(saved / "model.safetensors")
    expected = policy.behavior.weights
    assert {name: t.tolist() for name, t in tensors.items()} == {
        name: t.tolist() for name, t in expected.items()
    }


def test_policy_makes_its_environment(policy: Policy) -> None:
    env = policy.make_environment(render_mode="rgb_array")
    observation, _ = env.reset(seed=1)
    assert observation.shape == (2, 4)
    assert policy.predict(observation, 100.0, 100) in (0, 1)
    assert isinstance(env.render(), np.ndarray)
    env.close()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (b"{", "export the run again"),
        (b'{"format": 2}', "missing required field"),
        (b'{"format": 2, "surplus": 2}', "export the run again"),
    ],
)
def test_invalid_description_is_rejected(saved: Path, changed: bytes, message: str) -> None:
    (saved / "config.json").write_bytes(changed)
    with pytest.raises(InvalidData, match=message):
        udrl.load(saved)


def test_unknown_format_version_is_rejected_and_can_be_overwritten(
    policy: Policy, saved: Path
) -> None:
    description = json.loads((saved / "config.json").read_text())
    of_another = description | {"format": 1, "surplus": 2}
    (saved / "config.json").write_text(json.dumps(of_another))
    with pytest.raises(InvalidData, match="format 1, this version of udrl reads 2"):
        udrl.load(saved)
    folder.save_folder(saved, policy, "# A card\n")
    assert udrl.load(saved).desired_return == policy.desired_return


def test_weights_of_another_architecture_are_rejected(saved: Path) -> None:
    description = json.loads((saved / "config.json").read_text())
    description["config"]["hidden"] = [16, 32]
    (saved / "config.json").write_text(json.dumps(description))
    with pytest.raises(InvalidWeights, match=r"agent/model\.safetensors: .*another architecture"):
        udrl.load(saved)


def test_missing_folder_is_rejected(tmp_path: Path, policy: Policy) -> None:
    with pytest.raises(ConfigError, match="or a folder that udrl export --folder wrote"):
        udrl.load(tmp_path / "nothing")
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="choose a writable folder"):
        folder.save_folder(tmp_path / "file", policy, "")


def test_package_exports_nothing_else() -> None:
    assert {"train", "load", "__version__"} <= set(dir(udrl))
    assert set(udrl.__all__) <= set(dir(udrl))
    assert not {"Any", "TYPE_CHECKING", "entry_points"} & set(dir(udrl))
    with pytest.raises(AttributeError, match="'udrl' has no attribute 'loads'"):
        udrl.loads  # noqa: B018


def test_folder_with_other_files_is_not_overwritten(
    policy: Policy, saved: Path, tmp_path: Path
) -> None:
    (tmp_path / "README.md").write_text("precious")
    with pytest.raises(ConfigError, match="something other than an exported agent"):
        folder.save_folder(tmp_path, policy, "")
    assert (tmp_path / "README.md").read_text() == "precious"
    folder.save_folder(saved, policy, "# Another card\n")
    assert (saved / "README.md").read_text() == "# Another card\n"
