"""Exports: a run's agent as a folder with a model card, its episodes as a dataset."""

import shlex
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

from udrl import folder as folders
from udrl.atomic_files import write_atomically
from udrl.config import change
from udrl.datasets import write_dataset
from udrl.errors import ConfigError, StoreError
from udrl.evaluation import return_text
from udrl.file_remedies import file_remedy
from udrl.version import __version__
from udrl_inspect.agents import Agent, stored_evaluation
from udrl_inspect.hub import HUB_SCHEME, upload
from udrl_inspect.inspection import budget_of
from udrl_inspect.obedience_report import ObedienceReport, report_of_agent
from udrl_inspect.obedience_text import markdown
from udrl_proto.codec import LARGEST, decode, decode_episode
from udrl_proto.messages import EpisodeMessage, Hello
from udrl_proto.text import printable
from udrl_replay.creation import write_config
from udrl_replay.database import exists
from udrl_replay.progress import RunProgress
from udrl_replay.store import EvaluationRow, Store

_CARD = """\
---
library_name: udrl
tags:
  - reinforcement-learning
  - upside-down-rl
  - {environment}
{index}---

# Command-conditioned agent for {environment}

An agent trained by [Upside-Down Reinforcement Learning](https://arxiv.org/abs/1912.02877). It takes
a command: *get this return within this many steps*.

{results}

{obedience}## Use

```python
{example}```

This needs `{needs}` and the environment's dependencies.

## Training

```sh
{command}
```

udrl {version}, seed {seed}, weights version {weights}. All settings are in `config.toml` in this
folder. {again}
"""

_OBEDIENCE = """\
## Which returns it obtains

{report}

"""

_INDEX = """\
model-index:
  - name: udrl-{environment}
    results:
      - task:
          type: reinforcement-learning
          name: reinforcement-learning
        dataset:
          name: {environment}
          type: {environment}
        metrics:
          - type: mean_reward
            name: mean_reward
            value: {mean} +/- {std}
            verified: false
"""

_EXAMPLE = """\
import udrl

policy = udrl.load("{address}")
env = policy.make_environment()
observation, _ = env.reset(seed=1)
policy.reset()
desired_return, desired_horizon, over = policy.desired_return, policy.desired_horizon, False
while not over:
    action = policy.predict(observation, desired_return, desired_horizon{sampling})
    observation, reward, terminated, truncated, _ = env.step(action)
    desired_return, desired_horizon = desired_return - float(reward), desired_horizon - 1
    over = terminated or truncated
"""


def export_folder(agent: Agent, run_dir: Path, folder: Path, address: str | None = None) -> None:
    """Write an agent, its settings and a model card with the results of its evaluation.

    The card includes the report of ``udrl obedience`` if it was measured with these weights.

    Args:
        agent: the agent.
        run_dir: the directory of its run.
        folder: the folder to write.
        address: what ``udrl.load`` reads in the card's example. None: the folder's name.

    Raises:
        ConfigError: the folder cannot be written, or it is a run directory.
        InvalidData: the report is damaged.
        StoreError: the run cannot be read.
    """
    if exists(folder):
        raise ConfigError(f"{folder} is the directory of a run; use another folder")
    with closing(Store(run_dir, read_only=True)) as store:
        progress = store.fact("progress", RunProgress)
        found = stored_evaluation(store, agent)
    policy = agent.policy
    if found is not None:  # the command of the card's results
        policy.desired_return, policy.desired_horizon = found.desired_return, found.desired_horizon
    report, again = report_of_agent(agent, run_dir), _reproducibility(agent, progress)
    folders.save_folder(
        folder, policy, _card(agent, address or printable(folder.name), found, report, again)
    )
    # The card promises that a run with these settings keeps the exported version.
    write_config(folder, agent.config, change(budget_of(run_dir), keep_versions=None))


def export_to_hub(agent: Agent, run_dir: Path, repo_id: str, *, public: bool) -> str:
    """Upload an agent to the Hugging Face Hub: its folder, and its ONNX model; return the URL.

    Raises:
        ConfigError: the extra is not installed, or the Hub refuses.
        InvalidData: the report of ``udrl obedience`` is damaged.
        StoreError: the run cannot be read.
        Unreachable: the Hub does not respond.
    """
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        export_folder(agent, run_dir, folder, f"{HUB_SCHEME}{repo_id}")
        export_model(agent, folder / "model.onnx")
        return upload(folder, repo_id, public=public)


def export_model(agent: Agent, path: Path) -> None:
    """Write an agent's acting graph (:mod:`udrl.graph`) as an ONNX model.

    Raises:
        ConfigError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, agent.behavior.model)
    except OSError as error:
        what_to_do = file_remedy(error, "choose a writable file")
        raise ConfigError(f"{path}: {error.strerror}; {what_to_do}") from error


def export_buffer(run_dir: Path, name: str) -> int:
    """Write the replay buffer as a Minari dataset, lowest return first; return its size.

    Raises:
        ConfigError: the dataset cannot be written.
        StoreError: the run cannot be read.
    """
    with closing(Store(run_dir, read_only=True)) as store:
        hello = store.fact("hello", Hello)
        ids = [p.entry.id for p in store.buffer(store.fact("progress", RunProgress).iteration)]
        if not ids:
            raise StoreError(
                f"{run_dir}: the replay buffer is empty; wait until the warm-up is complete"
            )
        space = hello.environment.observation_space
        episodes = (
            decode_episode(decode(body, EpisodeMessage, LARGEST), space)
            for i in ids
            for body in store.episode_bodies([i], LARGEST)
        )
        write_dataset(name, episodes, hello.config, hello.environment)
    return len(ids)


def _reproducibility(agent: Agent, progress: RunProgress) -> str:
    """Return a sentence about the weights that the card's command trains."""
    config = agent.config
    if progress.inexact_reason:
        text = (
            f"The run was not exact ({progress.inexact_reason}), so this command trains different "
            f"weights."
        )
    elif progress.state == "ended" and agent.version == progress.latest_version:
        text = "On the same kind of hardware this command trains bit-identical weights."
    else:
        text = (
            f"On the same kind of hardware, version {agent.version} of this command's run has "
            f"bit-identical weights. The run continues after it, and keeps the versions that it "
            f"evaluates."
        )
    if config.commands.dataset is not None:
        text += f" It needs the dataset `{config.commands.dataset}`."
    return text


def _card(
    agent: Agent,
    address: str,
    found: EvaluationRow | None,
    report: ObedienceReport | None,
    again: str,
) -> str:
    environment = agent.config.environment
    temperature = agent.config.evaluation.eval_temperature
    sampling = "" if temperature == 1 else f", temperature={temperature}"  # 1 is the default
    results, index = "These weights were not evaluated.", ""
    if found is not None:
        mean, std, low, high, episodes = found.evaluation
        index = _INDEX.format(environment=environment, mean=return_text(mean), std=return_text(std))
        results = (
            f"**Mean return {return_text(mean)}** (95 % interval {return_text(low)} to "
            f"{return_text(high)}, standard deviation {return_text(std)}, {episodes} episodes with "
            f"unseen seeds) for a desired return of {return_text(found.desired_return)} within "
            f"{found.desired_horizon} steps at temperature {temperature:g}, after "
            f"{found.env_steps:,} env steps of training."
        )
    return _CARD.format(
        environment=environment,
        index=index,
        results=results,
        obedience="" if report is None else _OBEDIENCE.format(report=markdown(report)),
        example=_EXAMPLE.format(address=address, sampling=sampling),
        needs="udrl[hub]" if address.startswith(HUB_SCHEME) else "udrl",
        command=shlex.join(
            ["udrl", "train", environment, "--preset", "none", "--config", "config.toml"]
        ),
        version=__version__,
        seed=agent.config.seed,
        weights=agent.version,
        again=again,
    )
