"""The rows of the studies' tables (:mod:`udrl_inspect.csv_tables`)."""

import msgspec

#: Variant of the participant ``UDRL-paper``.
PAPER = "paper"


def agent_name(algorithm: str, variant: str) -> str:
    """Return an agent's name in output: ``UDRL``, ``UDRL-paper``, ``UDRL lead 2``."""
    return f"{algorithm}{'-' if variant == PAPER else ' '}{variant}".rstrip()


class EvaluationRecord(msgspec.Struct, frozen=True, kw_only=True):
    """An evaluation of an agent during training (section 3.2).

    Attributes:
        environment: Gymnasium's id.
        algorithm: one of :data:`udrl_experiments.protocol.Algorithm`.
        variant: label that distinguishes agents of a study, e.g. ``lead 2``; may be empty.
        seed: seed of the run.
        env_steps: training steps before the evaluation.
        wall_s: seconds from the start of training to the end of the evaluation.
        mean: mean return.
        std: sample standard deviation of the returns.
        episodes: number of episodes.
    """

    environment: str
    algorithm: str
    variant: str
    seed: int
    env_steps: int
    wall_s: float
    mean: float
    std: float
    episodes: int


class Obtained(msgspec.Struct, frozen=True, kw_only=True):
    """Returns that a trained agent obtained for a command (section 3.5).

    Attributes:
        environment: Gymnasium's id.
        seed: seed of the run.
        env_steps: training steps of the agent.
        desired_return: desired return of the command.
        desired_horizon: desired horizon of the command, in steps.
        mean: mean obtained return.
        std: sample standard deviation of the obtained returns.
        episodes: number of episodes.
    """

    environment: str
    seed: int
    env_steps: int
    desired_return: float
    desired_horizon: int
    mean: float
    std: float
    episodes: int
