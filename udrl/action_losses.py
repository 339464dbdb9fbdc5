"""Losses and values of actions, in torch; :mod:`udrl.actions` does not need torch."""

from torch import Tensor
from torch.nn import functional

from udrl.actions import ActionSpace, Product


def negative_log_likelihood(space: ActionSpace, parameters: Tensor, action: Tensor) -> Tensor:
    """Return the mean of -ln P(a) over a batch, in nats.

    Args:
        space: the action space.
        parameters: parameters of P, float32 [batch, n_parameters].
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


def kl_divergence(space: ActionSpace, parameters: Tensor, others: Tensor) -> Tensor:
    """Return the KL divergence of P from another distribution, in nats, float32 [batch].

    Args:
        space: the action space.
        parameters: parameters of P, float32 [batch, n_parameters].
        others: parameters of the other distribution, likewise.
    """
    ns = space.ns if isinstance(space, Product) else (space.n,)
    total = parameters.new_zeros(len(parameters))
    for p, q in zip(parameters.split(ns, dim=1), others.split(ns, dim=1), strict=True):
        log_p, log_q = p.log_softmax(1), q.log_softmax(1)
        total = total + (log_p.exp() * (log_p - log_q)).sum(1)
    return total


def of_action(space: ActionSpace, values: Tensor, action: Tensor) -> Tensor:
    """Return the values of actions, float32 [batch].

    The value of an action with several components is the sum of their values.

    Args:
        space: the action space.
        values: one value for each value of each component, float32 [batch, n_parameters].
        action: a, int64 [batch, *shape].
    """
    if not isinstance(space, Product):
        return values.gather(1, action[:, None])[:, 0]
    first = action.new_tensor(space.ends) - action.new_tensor(space.ns)
    return values.gather(1, action + first).sum(1)
