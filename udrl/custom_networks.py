"""Custom behavior functions (``behavior = "package.module:Class"``).

A custom behavior function is a torch module, created from the environment's specification and the
network's settings::

    class MyNetwork(torch.nn.Module):
        def __init__(self, spec: EnvironmentSpec, network: NetworkSettings) -> None:
            super().__init__()
            ...

        def forward(self, *inputs: Tensor) -> Tensor:
            *observation, command = inputs
            ...

``observation`` has the stacked observations (:mod:`udrl.frame_stack`), one tensor for each leaf,
[batch, *shape], float32, uint8 or int32. ``command`` is (desired return, desired horizon), scaled,
and relative to V(s) with a ``baseline``, float32 [batch, 2]. The module returns the parameters of
P(a | s, c), float32 [batch, n_parameters]. The result must depend only on inputs and parameters (no
dropout), and use only operators of ONNX's operator set 13. The module draws its own parameters,
with torch's generator, which is seeded for the run.

The process that creates a run needs torch and the class, and so does the learner. All other
processes compute the ONNX graph that is exported from the module when the run is created.
"""

import io
import warnings
from importlib import import_module

import onnx
import torch
from torch import Tensor, nn

from udrl.environments.specification import EnvironmentSpec
from udrl.errors import ConfigError
from udrl.frame_stack import FrameStack
from udrl.onnx_nodes import OPSET
from udrl.setting_groups import NetworkSettings
from udrl.spaces import leaves_of
from udrl.targets import ReturnInTime


def make_custom(network: NetworkSettings, spec: EnvironmentSpec) -> nn.Module:
    """Return an instance of the class named by ``behavior``.

    Raises:
        ConfigError: the class cannot be imported or instantiated, or is no torch module.
    """
    name = network.behavior or ""
    module, colon, attribute = name.partition(":")
    try:
        if not colon:
            raise ValueError("there is no colon")  # noqa: TRY301 - one message for all faults
        made = getattr(import_module(module), attribute)(spec, network)
    except (Exception, SystemExit) as error:
        raise ConfigError(
            f"behavior {name!r} cannot be created: {type(error).__name__}: {error}; name a class "
            f"that is importable here, as package.module:Class, and takes a specification and "
            f"settings (udrl.custom_networks)"
        ) from error
    if not isinstance(made, nn.Module):
        raise ConfigError(
            f"behavior {name!r} is {type(made).__name__}, expected a torch.nn.Module; derive the "
            f"class from it"
        )
    return made


def exported(network: NetworkSettings, spec: EnvironmentSpec) -> onnx.ModelProto:
    """Return the module as an ONNX model; its parameters are initializers without values.

    Raises:
        ConfigError: it cannot be created or exported, its output has the wrong shape or dtype, or
            it has tensors that are not trained or parameters that have no effect.
    """
    module = make_custom(network, spec).train(mode=False)
    shapes = FrameStack(spec.observation_space, network.frame_stack).shapes
    dtypes = [leaf.space.dtype.name for leaf in leaves_of(spec.observation_space)]
    inputs = [
        torch.zeros(2, *shape, dtype=getattr(torch, dtype))
        for shape, dtype in zip(shapes, dtypes, strict=True)
    ]
    inputs.append(torch.zeros(2, ReturnInTime.size))
    try:
        with torch.no_grad():
            _check_output(module(*inputs), spec)
        model = _export(module, inputs)
    except Exception as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(
            f"behavior {network.behavior!r} cannot be computed or exported: "
            f"{type(error).__name__}: {error}; see udrl.custom_networks for its requirements"
        ) from error
    trained = {name for name, tensor in module.named_parameters() if tensor.requires_grad}
    if others := sorted(module.state_dict().keys() - trained):
        raise ConfigError(
            f"behavior {network.behavior!r}: {', '.join(others[:4])} would not be trained; "
            f"register constants with register_buffer(..., persistent=False)"
        )
    for tensor in model.graph.initializer:
        if tensor.name in trained:
            tensor.ClearField("raw_data")
            trained.remove(tensor.name)
    if trained:
        raise ConfigError(
            f"behavior {network.behavior!r}: its parameters {', '.join(sorted(trained)[:4])} have "
            f"no effect on what it returns; leave them out"
        )
    return model


def _check_output(found: Tensor, spec: EnvironmentSpec) -> None:
    expected = (2, spec.action_space.n_parameters)
    if tuple(found.shape) != expected or found.dtype != torch.float32:
        raise ConfigError(
            f"the behavior function returns {found.dtype} {tuple(found.shape)} for a batch of 2, "
            f"expected torch.float32 {expected}"
        )


def _export(module: nn.Module, inputs: list[Tensor]) -> onnx.ModelProto:
    names = [f"input.{k}" for k in range(len(inputs))]
    file = io.BytesIO()
    with warnings.catch_warnings():
        # The newer exporter needs more packages and renames the parameters.
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            module,
            tuple(inputs),
            file,  # type: ignore[arg-type]  # the legacy exporter takes files
            dynamo=False,
            opset_version=OPSET,
            do_constant_folding=False,
            input_names=names,
            output_names=["logits"],
            dynamic_axes={name: {0: "batch"} for name in (*names, "logits")},
        )
    return onnx.load_model_from_string(file.getvalue())
