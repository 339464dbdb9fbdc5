"""The rows of the studies' tables (:mod:`udrl_inspect.csv_tables`)."""

import msgspec

#: Variant of the participant ``UDRL-paper``.
PAPER = "paper"


def agent_name(algorithm: str, variant: str) -> str:
    """Return an agent's name in output: ``UDRL``, ``UDRL-paper``, ``UDRL lead 2``."""
    return f"{algorithm}{'-' if variant == PAPER else ' '}{variant}".rstrip()


class EvaluationRecord(msgspec.Struct, frozen=True, kw_only=True):
    """An evaluation of one agent in training (section 3.2).

    Attributes:
        environment: Gymnasium's id.
        algorithm: one of :data:`udrl_experiments.protocol.Algorithm`.
        variant: what sets the agent apart within the study, e.g. ``lead 2``; may be empty.
        seed: of the run.
        env_steps: training steps before it.
        wall_s: seconds of training and evaluations before it, and its own.
        mean: of the episodes' returns.
        std: standard deviation of the sample of returns.
        episodes: how many.
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
    """What a trained agent obtained when it was told a return (section 3.5), over many episodes.

    Attributes:
        environment: Gymnasium's id.
        seed: of the run.
        env_steps: training steps of the agent.
        desired_return: what it was told.
        desired_horizon: what it was told, in steps.
        mean: of the episodes' returns.
        std: standard deviation of the sample of returns.
        episodes: how many.
    """

    environment: str
    seed: int
    env_steps: int
    desired_return: float
    desired_horizon: int
    mean: float
    std: float
    episodes: int
