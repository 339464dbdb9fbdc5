"""Evaluation of networks at every step of the buffer: their outputs and memory states."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from udrl.batches import SeenTensors, Windows, tensor_of
from udrl.config import Config
from udrl.experience import RankedExperience
from udrl.segments import Segments

#: Maps observations, actions (int64) and states before to outputs and states after.
Network = Callable[[SeenTensors, Tensor, Tensor | None], tuple[Tensor, Tensor | None]]

#: Number of episodes whose windows are evaluated at once.
_EPISODES_AT_ONCE = 128


class BufferOutputs(NamedTuple):
    """A network's results on the buffer.

    Attributes:
        outputs: outputs at each step, in the order of :meth:`.experience.RankedExperience.steps`,
            [steps, ...].
        states: with a memory, its state before each window (:class:`udrl.batches.Windows`), float32
            [windows, size], on the network's device.
    """

    outputs: npt.NDArray[np.float32]
    states: Tensor | None


def at_all_steps(
    network: Network, size: int, experience: RankedExperience, config: Config
) -> BufferOutputs:
    """Evaluate a network at every step of the buffer.

    Args:
        network: the network; called in inference mode.
        size: size of its memory's state; 0: no memory.
        experience: the buffer.
        config: ``memory_window``, ``device``.
    """
    device = config.arithmetic.device
    with torch.inference_mode():
        if size:
            outputs, states = _window_by_window(network, size, experience, config)
        else:
            outputs, states = _part_by_part(network, experience, device), None
    # Training cannot use tensors made in inference mode, but it can use copies.
    return BufferOutputs(outputs, None if states is None else states.clone())


def _part_by_part(
    network: Network, experience: RankedExperience, device: str
) -> npt.NDArray[np.float32]:
    """Evaluate a network without a memory, some steps at a time; return its outputs."""
    return np.concatenate(
        [
            network(_to_device(arrays, device), _to_indices(actions, device), None)[0].cpu().numpy()
            for arrays, actions in experience.steps()
        ]
    )


def _window_by_window(
    network: Network, size: int, experience: RankedExperience, config: Config
) -> tuple[npt.NDArray[np.float32], Tensor]:
    """Evaluate a network with a memory; return its outputs, and its state before each window.

    The k-th windows of all episodes are evaluated before their next ones.
    """
    lengths, device = experience.lengths, config.arithmetic.device
    windows = Windows(lengths, config.training.memory_window)
    states = torch.zeros(int(windows.counts.sum()), size, device=device)
    first_step = np.cumsum(lengths) - lengths
    outputs: npt.NDArray[np.float32] | None = None
    for chunk in range(int(windows.counts.max())):
        unfinished = np.flatnonzero(windows.counts > chunk)
        ends = range(_EPISODES_AT_ONCE, len(unfinished), _EPISODES_AT_ONCE)
        for ranks in np.split(unfinished, ends):
            segments, valid = windows.steps(ranks, np.full(len(ranks), chunk))
            examples = experience.examples(Segments(*(s.reshape(-1) for s in segments)))
            numbers = torch.from_numpy(windows.first[ranks] + chunk).to(device)
            found, after = network(
                _to_device(examples.seen, device),
                _to_indices(examples.action, device),
                states[numbers],
            )
            assert after is not None
            continues = torch.from_numpy(windows.counts[ranks] > chunk + 1).to(device)
            states[numbers[continues] + 1] = after[continues]
            values = found.cpu().numpy()
            if outputs is None:
                outputs = np.empty((int(lengths.sum()), *values.shape[1:]), np.float32)
            step = (first_step[segments.rank] + segments.t1)[valid]
            outputs[step] = values[valid.reshape(-1)]
    assert outputs is not None
    return outputs, states


def _to_device(arrays: tuple[npt.NDArray[Any], ...], device: str) -> SeenTensors:
    return tuple(tensor_of(one).to(device) for one in arrays)


def _to_indices(actions: npt.NDArray[Any], device: str) -> Tensor:
    return torch.from_numpy(actions.astype(np.int64)).to(device)
