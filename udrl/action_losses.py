"""What kinds of actions are to training, in torch; :mod:`udrl.actions` is without it."""

from torch import Tensor
from torch.nn import functional

from udrl.actions import ActionSpace, Product


def negative_log_likelihood(space: ActionSpace, parameters: Tensor, action: Tensor) -> Tensor:
    """Return the mean of -ln P(a) over a batch, nats.

    Args:
        space: of the actions.
        parameters: of P, float32 [batch, n_parameters].
        action: a, int64 [batch, *shape].
    """
    if not isinstance(space, Product):
        return functional.cross_entropy(parameters, action)
    if len(set(space.ns)) == 1:
        by_component = parameters.reshape(-1, space.ns[0])
        return functional.cross_entropy(by_component, action.reshape(-1)) * len(space.ns)
    parts = parameters.split(space.ns, dim=1)
    losses = [functional.cross_entropy(p, action[:, k]) for k, p in enumerate(parts)]
    return sum(losses[1:], losses[0])


def of_action(space: ActionSpace, values: Tensor, action: Tensor) -> Tensor:
    """Return the value of an action, float32 [batch], from one for each parameter.

    That of several components is the sum of theirs.

    Args:
        space: of the actions.
        values: float32 [batch, n_parameters].
        action: int64 [batch, *shape].
    """
    if not isinstance(space, Product):
        return values.gather(1, action[:, None])[:, 0]
    first = action.new_tensor(space.ends) - action.new_tensor(space.ns)
    return values.gather(1, action + first).sum(1)
