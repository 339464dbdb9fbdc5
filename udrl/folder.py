"""An exported agent as a folder with weights, settings and a model card.

::

    model.safetensors   the behavior function's weights
    config.json         :class:`Description`: settings, spaces and default command
    README.md           the model card
    graph.onnx          the graph of a custom behavior function, without weights
"""

from pathlib import Path

import msgspec

from udrl.atomic_files import write_atomically
from udrl.config import Configured, FlatSettings, flat
from udrl.environments.specification import EnvironmentSpec
from udrl.errors import ConfigError, InvalidData, InvalidWeights, UdrlError
from udrl.file_remedies import file_remedy
from udrl.graph import acting_graph
from udrl.policy import Policy
from udrl.weights import decode_behavior, encode_weights

FORMAT = 2

_WEIGHTS, _DESCRIPTION, _CARD = "model.safetensors", "config.json", "README.md"
_GRAPH = "graph.onnx"
#: The files that :func:`load_folder` reads.
FILES = _DESCRIPTION, _WEIGHTS, _GRAPH
#: Maximum size of a file.
MAX_BYTES = 4 << 30


class Description(
    Configured, msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True
):
    """Description of an exported agent.

    Attributes:
        format: format of the folder, :data:`FORMAT`.
        settings: settings of the agent's run.
        environment: specification of its environment.
        desired_return: desired return of evaluation commands (2.3.6).
        desired_horizon: desired horizon of evaluation commands, in steps.
    """

    format: int
    settings: FlatSettings = msgspec.field(name="config")
    environment: EnvironmentSpec
    desired_return: float
    desired_horizon: int


class _Format(msgspec.Struct, frozen=True):
    """The part of a description that all formats have."""

    format: int


def save_folder(folder: Path, policy: Policy, card: str) -> None:
    """Write a policy to a folder, which may exist.

    Args:
        folder: new or empty folder, or one with an exported agent, which is overwritten.
        policy: the agent, with a default command.
        card: text of README.md.

    Raises:
        ConfigError: the folder cannot be written, or contains something else.
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
    _refuse_foreign(folder)
    described = msgspec.json.format(msgspec.json.encode(description), indent=2)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / _WEIGHTS, encode_weights(policy.behavior.weights))
        write_atomically(folder / _DESCRIPTION, described + b"\n")
        write_atomically(folder / _CARD, card.encode())
        if policy.config.network.behavior is not None:
            write_atomically(folder / _GRAPH, policy.behavior.graph)
    except OSError as error:
        what_to_do = file_remedy(error, "choose a writable folder")
        raise ConfigError(f"{folder}: {error.strerror}; {what_to_do}") from error


def load_folder(folder: str | Path) -> Policy:
    """Return a policy written by :func:`save_folder`.

    Its ``desired_return`` and ``desired_horizon`` are those of evaluation commands.

    Args:
        folder: a folder written by ``udrl export RUN_DIR --folder FOLDER``.

    Raises:
        ConfigError: a file cannot be read.
        InvalidData: a file's content is invalid.
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
    try:
        behavior = decode_behavior(graph, weights)
    except InvalidWeights as error:
        raise InvalidWeights(f"{folder / _WEIGHTS}: {error}") from error
    return Policy(
        behavior,
        config,
        description.environment,
        desired_return=description.desired_return,
        desired_horizon=description.desired_horizon,
    )


def _refuse_foreign(folder: Path) -> None:
    """Raise :class:`ConfigError` unless a folder is missing, empty, or has an exported agent."""
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    try:
        msgspec.json.decode(_read(folder / _DESCRIPTION), type=_Format)
    except (msgspec.DecodeError, UdrlError) as error:
        raise ConfigError(
            f"{folder} contains something other than an exported agent; name a new folder"
        ) from error


def _read(path: Path) -> bytes:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InvalidData(
                f"{path}: {path.stat().st_size:,} bytes, expected at most {MAX_BYTES:,}; export "
                f"the run again"
            )
        return path.read_bytes()
    except OSError as error:
        raise ConfigError(
            f"{path}: {error.strerror}; name a run directory, or a folder that udrl export "
            f"--folder wrote"
        ) from error
