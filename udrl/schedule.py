"""Which weights an iteration acts with, and which buffer its commands come from.

Iteration 0 is the warm-up. Weights version v is trained from version v-1 on the buffer as it is
after iteration v-1. With ``lead = L``, iteration i acts with version max(1, i - L); its commands
are drawn from the buffer that version was trained on. ``lead = 0`` is Algorithm 1: train, act,
train, act. With L > 0 actors work while the learner trains, and the result is still a function of
the configuration.
"""


def weights_version(iteration: int, lead: int) -> int:
    """Return the weights version that an iteration's commands name; 0 means: act at random."""
    return 0 if iteration == 0 else max(1, iteration - lead)


def opened_by(completed: int, lead: int) -> range:
    """Return the iterations whose commands are drawn from the buffer after ``completed``."""
    return (
        range(1, lead + 2) if completed == 0 else range(completed + lead + 1, completed + lead + 2)
    )


def evaluation_due(completed: int, steps_before: int, steps_after: int, every: int) -> bool:
    """Say whether the first iteration opened by ``completed`` carries an evaluation.

    It does when that iteration's completion took ``env_steps`` past a multiple of ``every``.

    Args:
        completed: the iteration whose buffer commands are drawn from.
        steps_before: env steps of the buffer before it was completed.
        steps_after: env steps of the buffer after it.
        every: env steps between evaluations.
    """
    return steps_after // every > (0 if completed == 0 else steps_before) // every
