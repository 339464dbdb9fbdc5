"""All three services in one process, with real Zenoh, learn CartPole."""

from collections.abc import Callable

from udrl.config import Config, build, preset
from udrl_proto.reports import Status


def test_cartpole_reaches_200(run: Callable[..., Status]) -> None:
    settings = {k: v for k, v in preset("CartPole-v1").items() if k != "max_env_steps"}
    settings |= {"eval_every": 10_000, "eval_episodes": 20, "eval_temperature": 0.0}
    status = run(build(Config, settings), 200_000, stop_return=200.0)
    assert status.final_evaluation is not None
    assert status.final_evaluation.mean > 200
