"""Memory of the networks (section 6): a gated recurrent unit.

It comes between the encoder and the command, so its state depends on observations alone. Training
can therefore recompute the states of acting from the observations, independently of the commands.
:mod:`udrl.graph` has the same unit for acting, one step at a time.
"""

from torch import Tensor, nn


class Memory(nn.Module):
    """A gated recurrent unit over the features of consecutive steps.

    Args:
        n_in: number of features.
        size: size of the state.
    """

    def __init__(self, n_in: int, size: int) -> None:
        super().__init__()
        self.size = size
        self.cell = nn.GRU(n_in, size, batch_first=True)

    def forward(self, features: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return the state after each step, and after the last step of each window.

        Args:
            features: features of windows of consecutive steps, window by window,
                [windows * steps, n_in].
            state: state before the first step of each window, float32 [windows, size].

        Returns:
            [windows * steps, size] in the precision of the features, float32 [windows, size].
        """
        by_window = features.float().unflatten(0, (len(state), -1))
        remembered, last = self.cell(by_window, state[None])
        return remembered.flatten(0, 1).to(features.dtype), last[0]
