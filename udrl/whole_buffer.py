"""Networks evaluated at every step of the buffer: what is expected there, and what remembered."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from udrl.batches import Seen, Windows, tensor_of
from udrl.config import Config
from udrl.segments import RankedExperience, Segments

#: From what is seen, the actions (int64) and the states before: the outputs, and the states after.
Network = Callable[[Seen, Tensor, Tensor | None], tuple[Tensor, Tensor | None]]

#: Episodes whose windows are evaluated at once.
_AT_ONCE = 128


class BufferOutputs(NamedTuple):
    """What a network says of the buffer.

    Attributes:
        outputs: at each step, in the order of :meth:`.segments.RankedExperience.steps`,
            [steps, ...].
        states: with a memory, before each window (:class:`udrl.batches.Windows`), float32
            [windows, size], where the network is.
    """

    outputs: npt.NDArray[np.float32]
    states: Tensor | None


def at_all_steps(
    network: Network, size: int, experience: RankedExperience, config: Config
) -> BufferOutputs:
    """Evaluate a network at every step of the buffer.

    Args:
        network: in inference.
        size: numbers that it remembers; 0: nothing.
        experience: the buffer.
        config: ``memory_window``, ``device``.
    """
    device = config.arithmetic.device
    with torch.inference_mode():
        if size:
            outputs, states = _window_by_window(network, size, experience, config)
        else:
            outputs, states = _part_by_part(network, experience, device), None
    # Training cannot use what was made in inference mode, but a copy of it.
    return BufferOutputs(outputs, None if states is None else states.clone())


def _part_by_part(
    network: Network, experience: RankedExperience, device: str
) -> npt.NDArray[np.float32]:
    return np.concatenate(
        [
            network(_placed(arrays, device), _acted(actions, device), None)[0].cpu().numpy()
            for arrays, actions in experience.steps()
        ]
    )


def _window_by_window(
    network: Network, size: int, experience: RankedExperience, config: Config
) -> tuple[npt.NDArray[np.float32], Tensor]:
    lengths, device = experience.lengths, config.arithmetic.device
    windows = Windows(lengths, config.training.memory_window)
    states = torch.zeros(int(windows.counts.sum()), size, device=device)
    first_step = np.cumsum(lengths) - lengths
    outputs: npt.NDArray[np.float32] | None = None
    for chunk in range(int(windows.counts.max())):
        there = np.flatnonzero(windows.counts > chunk)
        for ranks in np.split(there, range(_AT_ONCE, len(there), _AT_ONCE)):
            segments, valid = windows.steps(ranks, np.full(len(ranks), chunk))
            examples = experience.examples(Segments(*(s.reshape(-1) for s in segments)))
            numbers = torch.from_numpy(windows.first[ranks] + chunk).to(device)
            found, after = network(
                _placed(examples.seen, device), _acted(examples.action, device), states[numbers]
            )
            assert after is not None
            goes_on = torch.from_numpy(windows.counts[ranks] > chunk + 1).to(device)
            states[numbers[goes_on] + 1] = after[goes_on]
            values = found.cpu().numpy()
            if outputs is None:
                outputs = np.empty((int(lengths.sum()), *values.shape[1:]), np.float32)
            step = (first_step[segments.rank] + segments.t1)[valid]
            outputs[step] = values[valid.reshape(-1)]
    assert outputs is not None
    return outputs, states


def _placed(arrays: tuple[npt.NDArray[Any], ...], device: str) -> Seen:
    return tuple(tensor_of(one).to(device) for one in arrays)


def _acted(actions: npt.NDArray[Any], device: str) -> Tensor:
    return torch.from_numpy(actions.astype(np.int64)).to(device)
