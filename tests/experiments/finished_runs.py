"""Jobs on CartPole, and finished runs without training."""

from pathlib import Path
from typing import Any

import msgspec

from udrl.config import Config, build, change, flat
from udrl_experiments.jobs import Job
from udrl_experiments.provenance import Machine
from udrl_experiments.records import EvaluationRecord
from udrl_inspect.csv_tables import write

CONFIG = build(Config, {"environment": "CartPole-v1", "eval_every": 100})


def job(max_env_steps: int = 1000, variant: str = "", **changes: Any) -> Job:
    settings = flat(change(CONFIG, **changes))
    return Job(algorithm="UDRL", settings=settings, max_env_steps=max_env_steps, variant=variant)


def evaluated(env_steps: int) -> EvaluationRecord:
    return EvaluationRecord(
        environment="CartPole-v1", algorithm="UDRL", variant="", seed=1,
        env_steps=env_steps, wall_s=1.0, mean=2.0, std=3.0, episodes=4,
    )  # fmt: skip


def finish(root: Path, one: Job, *, wall_s: float = 10.0, machine: Machine | None = None) -> None:
    """Write the files of a finished run."""
    folder = one.folder(root)
    folder.mkdir(parents=True)
    rows = [
        EvaluationRecord(
            environment=one.config.environment, algorithm=one.algorithm, variant="",
            seed=one.config.seed, env_steps=env_steps, wall_s=wall_s * number,
            mean=float(one.config.seed + number), std=1.0, episodes=100,
        )
        for number, env_steps in enumerate((50_123, 100_045), 1)
    ]  # fmt: skip
    write(folder / "evaluations.csv", EvaluationRecord, rows)
    done = {"max_env_steps": one.max_env_steps, "machine": machine}
    (folder / "job.json").write_bytes(msgspec.json.encode(one))
    (folder / "done.json").write_bytes(msgspec.json.encode(done))
