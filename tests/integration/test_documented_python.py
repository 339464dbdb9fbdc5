"""The Python examples of the documentation run as printed."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from udrl import folder
from udrl.config import Config, build, preset
from udrl.environments import make_environment, specify
from udrl.graph import acting_graph
from udrl.inference import ActingFunction
from udrl.policy import Policy
from udrl.training import untrained

ROOT = Path(__file__).parents[2]
BLOCKS = re.findall(
    r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text(encoding="utf-8"), re.DOTALL
)


@pytest.fixture
def agent(tmp_path: Path) -> Path:
    """Create the folder that the examples load: an untrained agent."""
    settings = {k: v for k, v in preset("LunarLander-v3").items() if k != "max_env_steps"}
    config = build(Config, settings)
    env = make_environment(config)
    spec = specify(env, config)
    env.close()
    behavior = ActingFunction(acting_graph(config.network, spec), untrained(config, spec).weights)
    policy = Policy(behavior, config, spec, desired_return=200.0, desired_horizon=300)
    (tmp_path / "runs").mkdir()
    folder.save_folder(tmp_path / "runs" / "lander", policy, "")
    return tmp_path


def test_documentation_has_python_examples() -> None:
    assert [("udrl.train" in block, "udrl.load" in block) for block in BLOCKS] == [
        (True, False),
        (False, True),
        (False, True),
    ]


@pytest.mark.parametrize("block", BLOCKS, ids=["train", "load", "batch"])
def test_examples_run(agent: Path, block: str) -> None:
    # As printed, except for the length of the training.
    code = block.replace("max_env_steps=100_000", "max_env_steps=1_000")
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=agent, env=os.environ, capture_output=True, text=True,
        timeout=100, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    if "udrl.train" in block:
        assert "EvaluationStatus(" in done.stdout
        assert len(list((agent / "runs").iterdir())) == 2
