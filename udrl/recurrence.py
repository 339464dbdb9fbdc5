"""What the networks remember of an episode (section 6): a gated recurrent unit.

It stands between the encoder and the command, so that what is remembered depends on observations
alone: training then computes from them what acting computed, whatever had been commanded.
:mod:`udrl.graph` has the same for acting, one step at a time.
"""

from torch import Tensor, nn


class Memory(nn.Module):
    """A gated recurrent unit over the features of consecutive steps.

    Args:
        n_in: features.
        size: numbers that are remembered.
    """

    def __init__(self, n_in: int, size: int) -> None:
        super().__init__()
        self.size = size
        self.cell = nn.GRU(n_in, size, batch_first=True)

    def forward(self, features: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return what is remembered after each step, and after the last.

        Args:
            features: of windows of consecutive steps, one window after another,
                [windows * steps, n_in].
            state: before the first step of each window, float32 [windows, size].

        Returns:
            [windows * steps, size] in the precision of the features, float32 [windows, size].
        """
        by_window = features.float().unflatten(0, (len(state), -1))
        remembered, last = self.cell(by_window, state[None])
        return remembered.flatten(0, 1).to(features.dtype), last[0]
