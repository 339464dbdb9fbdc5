"""The weights version of each iteration, and the buffer that its commands are drawn from.

Iteration 0 is the warm-up. Weights version v is trained from version v-1 on the buffer after
iteration v-1. With ``lead = L``, iteration i acts with version max(1, i - L), and its commands are
drawn from the buffer that this version was trained on. ``lead = 0`` is Algorithm 1: train, act,
train, act. With L > 0 actors work while the learner trains, and the result still depends only on
the configuration.
"""


def weights_version(iteration: int, lead: int) -> int:
    """Return the weights version of an iteration's commands; 0 = random actions."""
    return 0 if iteration == 0 else max(1, iteration - lead)


def opened_by(completed: int, lead: int) -> range:
    """Return the iterations whose commands are drawn from the buffer after ``completed``."""
    return (
        range(1, lead + 2) if completed == 0 else range(completed + lead + 1, completed + lead + 2)
    )


def evaluation_due(steps_before: int, steps_after: int, every: int) -> bool:
    """Return whether the first iteration opened by a completed one includes an evaluation.

    It does if the completed one took ``env_steps`` to or past a multiple of ``every``.

    Args:
        steps_before: ``env_steps`` before the completed iteration; 0 before the warm-up.
        steps_after: ``env_steps`` after it.
        every: env steps between evaluations.
    """
    return steps_after // every > steps_before // every
