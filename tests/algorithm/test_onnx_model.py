"""The exported model, read by ONNX's own checker and runtime."""

import builtins
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest

from udrl.behavior import initialise
from udrl.config import Config, build
from udrl.environments.making import EnvironmentSpec
from udrl.errors import ConfigError
from udrl.onnx_model import export_onnx
from udrl.policy import Policy

VECTOR = EnvironmentSpec(observation_shape=(4,), n_actions=3, max_episode_steps=500)
IMAGE = EnvironmentSpec(
    observation_shape=(1, 16, 16), observation_dtype="uint8", n_actions=3, max_episode_steps=500
)

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


def policy(spec: EnvironmentSpec, **values: Any) -> Policy:
    small = {"environment": "Any-v0", "hidden": [16, 16], "convolutions": [4, 8]}
    config = build(Config, small | values)
    return Policy(initialise(config, spec), config, spec)


@pytest.mark.parametrize("rows", [1, 64])
@pytest.mark.parametrize(
    ("spec", "settings"),
    [
        (VECTOR, {}),
        (VECTOR, {"desired_horizon": "return", "activation": "tanh"}),
        (VECTOR, {"frame_stack": 3}),
        (IMAGE, {"frame_stack": 4}),
        (VECTOR, {"baseline": "value"}),
        (IMAGE, {"frame_stack": 4, "baseline": "value"}),
    ],
)
def test_it_acts_as_the_policy_does(
    tmp_path: Path, spec: EnvironmentSpec, settings: dict[str, Any], rows: int
) -> None:
    agent, path = policy(spec, return_scale=0.02, **settings), tmp_path / "deep" / "agent.onnx"
    export_onnx(agent, path)
    onnx.checker.check_model(onnx.load(path), full_check=True)
    rng = np.random.default_rng(1)
    shape = (rows, *agent.observation_shape)
    seen = rng.integers(0, 256, shape) if spec.is_image else rng.normal(0, 2, shape)
    seen = seen.astype(spec.observation_dtype)
    returns, horizons = rng.uniform(-50, 300, rows), rng.uniform(-20, 300, rows)
    (found,) = onnxruntime.InferenceSession(str(path)).run(
        None, {"observation": seen, "desired_return": returns, "desired_horizon": horizons}
    )
    expected = np.array([agent.logits(*row) for row in zip(seen, returns, horizons, strict=True)])
    assert found.dtype == np.float32
    assert found == pytest.approx(expected, abs=1e-4)
    actions = expected.argmax(1).tolist()
    assert found.argmax(1).tolist() == actions
    assert len(set(actions)) > 1 or rows == 1, "one action only proves little"


def test_the_extra_is_named_when_it_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = builtins.__import__

    def without(name: str, *rest: Any, **named: Any) -> Any:
        if name == "onnxscript":
            raise ModuleNotFoundError("No module named 'onnxscript'", name=name)
        return found(name, *rest, **named)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ConfigError, match=r'needs onnxscript; .*pip install "udrl\[onnx\]"'):
        export_onnx(policy(VECTOR), tmp_path / "agent.onnx")
