"""An agent as a folder that can be handed on: weights, settings, and a card that tells of it.

::

    model.safetensors   the behavior function's weights
    config.json         :class:`Description`: what they are the weights of
    README.md           the model card
    graph.onnx          with a behavior function of one's own: its graph, without weights
"""

from pathlib import Path

import msgspec

from udrl.config import Configured, FlatSettings, flat
from udrl.environments.making import EnvironmentSpec
from udrl.errors import ConfigError, InvalidData, UdrlError
from udrl.graph import acting_graph
from udrl.policy import Policy
from udrl.weights import decode_behavior, encode_weights

FORMAT = 2

_WEIGHTS, _DESCRIPTION, _CARD = "model.safetensors", "config.json", "README.md"
_GRAPH = "graph.onnx"
#: Weights of more than this nobody has trained with this project.
_MOST_BYTES = 4 << 30


class Description(
    Configured, msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True
):
    """What a folder's weights are.

    Attributes:
        format: of the folder, :data:`FORMAT`.
        settings: what they were trained with.
        environment: what it looks like to the network.
        desired_return: what the agent is asked for in evaluations (2.3.6).
        desired_horizon: in how many steps.
    """

    format: int
    settings: FlatSettings = msgspec.field(name="config")
    environment: EnvironmentSpec
    desired_return: float
    desired_horizon: int


class _Format(msgspec.Struct, frozen=True):
    """What folders of all formats have."""

    format: int


def save(folder: Path, policy: Policy, card: str) -> None:
    """Write a policy to a folder, which may be there already.

    Args:
        folder: where to.
        policy: the agent; what to ask it for must be known.
        card: the text of README.md.

    Raises:
        ConfigError: it cannot be written, or holds what is no such policy.
    """
    assert policy.desired_return is not None
    assert policy.desired_horizon is not None
    description = Description(
        format=FORMAT,
        settings=flat(policy.config),
        environment=policy.spec,
        desired_return=policy.desired_return,
        desired_horizon=policy.desired_horizon,
    )
    _refuse_others(folder)
    described = msgspec.json.format(msgspec.json.encode(description), indent=2)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / _WEIGHTS).write_bytes(encode_weights(policy.behavior.weights))
        (folder / _DESCRIPTION).write_bytes(described + b"\n")
        (folder / _CARD).write_text(card, encoding="utf-8")
        if policy.config.network.behavior is not None:
            (folder / _GRAPH).write_bytes(policy.behavior.graph)
    except OSError as error:
        raise ConfigError(
            f"{error.filename or folder}: {error.strerror}; name a folder you may write"
        ) from error


def load(folder: str | Path) -> Policy:
    """Return the policy that :func:`save` wrote.

    Its ``desired_return`` and ``desired_horizon`` are what it was asked for in evaluations.

    Args:
        folder: from ``udrl export RUN_DIR --folder FOLDER``.

    Raises:
        ConfigError: there is no such folder.
        InvalidData: the files are not what was written.
    """
    folder = Path(folder)
    described, weights = (_read(folder / name) for name in (_DESCRIPTION, _WEIGHTS))
    try:
        found = msgspec.json.decode(described, type=_Format).format
        if found != FORMAT:
            raise InvalidData(
                f"{folder / _DESCRIPTION}: format {found}, this version of udrl reads {FORMAT}; "
                f"export the run again"
            )
        description = msgspec.json.decode(described, type=Description)
    except (msgspec.ValidationError, msgspec.DecodeError, ConfigError) as error:
        raise InvalidData(
            f"{folder / _DESCRIPTION}: {error}; export the run again, with this version of udrl"
        ) from error
    config = description.config
    if config.network.behavior is None:
        graph = acting_graph(config.network, description.environment)
    else:
        graph = _read(folder / _GRAPH)
    behavior = decode_behavior(graph, weights)
    return Policy(
        behavior,
        config,
        description.environment,
        desired_return=description.desired_return,
        desired_horizon=description.desired_horizon,
    )


def _refuse_others(folder: Path) -> None:
    """Raise unless a folder is empty, or holds a policy that may be written again."""
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    try:
        msgspec.json.decode(_read(folder / _DESCRIPTION), type=_Format)
    except (msgspec.DecodeError, UdrlError) as error:
        raise ConfigError(
            f"{folder} holds something else than an exported agent; name a new folder"
        ) from error


def _read(path: Path) -> bytes:
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise InvalidData(f"{path}: larger than {_MOST_BYTES:,} bytes; these are no weights")
        return path.read_bytes()
    except OSError as error:
        raise ConfigError(
            f"{path}: {error.strerror}; name a run directory, or a folder that udrl export "
            f"--folder wrote"
        ) from error
