"""Guidance: acting goes further than the examples. Not in the paper.

A single action explains little of a return, so the behavior function's response to a high desired
return is only a little better than its usual behavior. In the agents measured, the response also
weakens in training until commands have no effect, and then returns decline. With a
``guidance_kl``, acting therefore extrapolates: it uses the parameters

    p(s, c) + g (p(s, c) - p(s, c')),

where c' is c with the lowest return: that of the examples, or with a ``baseline`` the lowest
relative return (:mod:`udrl.value`). The learner chooses g for each weights version, from 0 to 30,
so that the mean KL divergence of the policy for the highest return from that for the lowest is
about ``guidance_kl``. It is 0 if the divergence is larger anyway. Training does not use guidance.

This is classifier-free guidance (Ho and Salimans, 2022), which Frans et al. (2025) use as a policy
improvement operator.
"""

import math
from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from udrl.action_losses import kl_divergence
from udrl.batches import Batch
from udrl.behavior import BehaviorFunction
from udrl.value import with_return

#: Upper bound of g.
_MAX_FACTOR = 30.0
#: Number of examples from which g is chosen; the last batch may exceed it.
EXAMPLES = 4096


def choose_guidance(
    behavior: BehaviorFunction,
    batches: Callable[[], Iterable[tuple[Batch, Tensor | None]]],
    minimum: float,
) -> tuple[float, float]:
    """Return g and the return of c', scaled, for a trained behavior function.

    The divergence is about proportional to (1 + g)^2, which gives g from the divergence without
    guidance.

    Args:
        behavior: the behavior function.
        batches: returns batches of examples, and with a memory, its states before their windows;
            called once, or twice without a baseline. A batch is not used after the next one.
        minimum: mean divergence that is aimed at, in nats.
    """
    low, high = -behavior.bound, behavior.bound
    if behavior.value is None:
        returns = [b.counted(b.command)[:, 0].aminmax() for b, _ in batches()]
        low = min(float(lowest) for lowest, _ in returns)
        high = max(float(highest) for _, highest in returns)
    total, n = torch.zeros((), dtype=torch.float64), 0
    with torch.no_grad():
        for batch, states in batches():
            highest, lowest = (
                behavior.forward_relative(batch.seen, with_return(batch.command, level), states)
                for level in (high, low)
            )
            divergence = batch.counted(kl_divergence(behavior.spec.action_space, highest, lowest))
            total += divergence.double().sum().cpu()
            n += len(divergence)
    unguided = float(total) / n
    return min(max(0.0, math.sqrt(minimum / max(unguided, 1e-12)) - 1), _MAX_FACTOR), low
