"""A policy as an ONNX model, for whoever acts without Python or PyTorch.

Inputs: ``observation`` as the network sees it ([batch, *observation_shape], float32 vectors or
uint8 images), ``desired_return`` and ``desired_horizon`` (float64 [batch], neither scaled nor
bounded). Output: ``logits`` (float32 [batch, n_actions]) of P(a | s, c).
"""

import contextlib
import io
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path

import msgspec
import torch
from torch import Tensor, nn

from udrl.behavior import BehaviorFunction
from udrl.config import Config
from udrl.errors import ConfigError
from udrl.policy import Policy

#: Of ONNX's operators; every runtime of the last years knows it.
_OPSET = 18


class _Model(nn.Module):
    """What :class:`~udrl.policy.Policy` computes, in float32, for any number of rows."""

    def __init__(self, behavior: BehaviorFunction, config: Config) -> None:
        super().__init__()
        self._behavior = behavior
        self._config = config

    def forward(
        self, observation: Tensor, desired_return: Tensor, desired_horizon: Tensor
    ) -> Tensor:
        """Return the logits; compare :class:`udrl.acting.CommandReader`."""
        config = self._config
        horizon = desired_horizon
        if config.desired_horizon == "return":
            horizon = torch.floor(desired_return) + 0.0 * desired_horizon  # an input has to be used
            desired_return = torch.clamp(desired_return, min=1.0)
        horizon = torch.clamp(horizon, min=1.0)
        command = torch.stack(
            [desired_return * config.return_scale, horizon * config.horizon_scale], dim=1
        )
        logits: Tensor = self._behavior(observation, command.float())
        return logits


def export_onnx(policy: Policy, path: Path) -> None:
    """Write a policy as an ONNX model.

    It computes in float32, also where the run acts in bfloat16.

    Raises:
        ConfigError: the extra is not installed, or the file cannot be written.
    """
    try:
        import onnx  # noqa: F401
        import onnxscript  # noqa: F401
    except ModuleNotFoundError as error:
        raise ConfigError(
            f'an ONNX model needs {error.name}; install it with: pip install "udrl[onnx]"'
        ) from error
    config = msgspec.structs.replace(policy.config, precision="float32")
    behavior = BehaviorFunction(policy.spec, config)
    behavior.load_state_dict(policy.behavior.state_dict())
    rows = 2  # any number but 1, which the exporter would take for a constant
    observation = torch.zeros(rows, *policy.observation_shape)
    if policy.spec.is_image:
        observation = observation.to(torch.uint8)
    # Two tensors: of one that comes twice the exporter would make one input.
    desired = [torch.ones(rows, dtype=torch.float64) for _ in range(2)]
    batch = {0: torch.export.Dim("batch")}
    # It prints what it does, and warns of its own future.
    with (
        warnings.catch_warnings(),
        contextlib.redirect_stdout(io.StringIO()),
        _quiet("torch.onnx", "onnxscript", "onnx_ir"),
    ):
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            _Model(behavior, config),
            (observation, *desired),
            input_names=["observation", "desired_return", "desired_horizon"],
            output_names=["logits"],
            dynamic_shapes=(batch, batch, batch),
            opset_version=_OPSET,
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        program.save(str(path))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; name a file you may write") from error


@contextlib.contextmanager
def _quiet(*names: str) -> Iterator[None]:
    """Let some loggers say errors only."""
    levels = {name: logging.getLogger(name).level for name in names}
    for name in names:
        logging.getLogger(name).setLevel(logging.ERROR)
    try:
        yield
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)
