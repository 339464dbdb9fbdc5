"""``udrl export`` and its output."""

import errno
import os
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import onnxruntime
import pytest
from click.testing import CliRunner
from huggingface_hub import ModelCard

import udrl
from udrl.config import change
from udrl.errors import ConfigError, UdrlError
from udrl.evaluation import return_text
from udrl_inspect.agents import load_agent
from udrl_inspect.exporting import export_folder
from udrl_inspect.inspection import read_status
from udrl_launch.cli import cli as command_line
from udrl_replay.store import Store
from whole_run import Cli, small


def export(*arguments: object) -> str:
    result = CliRunner().invoke(
        command_line,
        ["export", *map(str, arguments)],
        standalone_mode=False,
        catch_exceptions=False,
    )
    assert result.return_value == 0
    return result.stdout


@pytest.fixture(scope="module")
def folder(ended_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exported") / "agent"
    assert f'udrl.load("{folder}")' in export(ended_run, "--folder", folder)
    return folder


def test_folder_has_the_runs_agent(ended_run: Path, folder: Path) -> None:
    agent, loaded = load_agent(ended_run), udrl.load(folder)
    seen = [0.1, 0.2, -0.3, 0.4]
    assert loaded.logits(seen, 70.0, 50).tolist() == agent.policy.logits(seen, 70.0, 50).tolist()
    assert (loaded.desired_return, loaded.desired_horizon) == (
        agent.policy.desired_return, agent.policy.desired_horizon,
    )  # fmt: skip


def test_card_has_the_hubs_metadata(ended_run: Path, folder: Path) -> None:
    card = ModelCard.load(folder / "README.md")
    last = read_status(ended_run).final_evaluation
    assert last is not None
    (result,) = card.data.eval_results
    assert result.dataset_name == "CartPole-v1"
    assert result.metric_value == f"{return_text(last.mean)} +/- {return_text(last.std)}"
    assert f"**Mean return {last.mean:.1f}**" in card.text
    assert card.data.library_name == "udrl"


def test_example_of_the_card_runs(folder: Path) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", (folder / "README.md").read_text(), re.DOTALL)
    subprocess.run(
        [sys.executable, "-W", "error", "-c", example + "assert terminated or truncated"],
        cwd=folder.parent, env=os.environ, check=True, timeout=100,
    )  # fmt: skip


def test_command_of_the_card_trains_the_same_agent(
    folder: Path, tmp_path: Path, cli: Callable[..., Cli]
) -> None:
    (command,) = re.findall(r"```sh\nudrl (.*)\n```", (folder / "README.md").read_text())
    words = command.replace("config.toml", str(folder / "config.toml")).split()
    cli(*words, "--run-dir", str(tmp_path / "run"), "--in-process", "--json").status()
    again = (tmp_path / "run" / "weights.safetensors").read_bytes()
    assert again == (folder / "model.safetensors").read_bytes()
    assert "this command trains bit-identical weights" in (folder / "README.md").read_text()


def test_earlier_weights_have_their_own_evaluation(ended_run: Path, tmp_path: Path) -> None:
    with closing(Store(ended_run, read_only=True)) as store:
        version = store.evaluations(-1, 10**9)[0].iteration - small().lead
    export(ended_run, "--folder", tmp_path / "best", "--weights", version)
    card = (tmp_path / "best" / "README.md").read_text()
    found = re.search(r"\*\*Mean return.*desired return of (\S+) within (\d+) steps", card)
    assert found is not None
    loaded = udrl.load(tmp_path / "best")
    assert f"{loaded.desired_return:.1f}" == found[1]
    assert str(loaded.desired_horizon) == found[2]
    # The command does not end with these weights, and the card must not claim so.
    assert f"version {version} of this command's run has bit-identical weights" in card
    assert "this command trains bit-identical weights" not in card


def test_card_states_the_temperature_of_its_results_and_uses_it(
    ended_run: Path, folder: Path, tmp_path: Path
) -> None:
    sampled = (folder / "README.md").read_text()
    assert "steps at temperature 1, after" in sampled
    assert "policy.predict(observation, desired_return, desired_horizon)\n" in sampled
    agent = load_agent(ended_run)
    greedy = agent._replace(config=change(agent.config, eval_temperature=0.0))
    export_folder(greedy, ended_run, tmp_path / "greedy")
    card = (tmp_path / "greedy" / "README.md").read_text()
    assert "steps at temperature 0, after" in card
    assert "policy.predict(observation, desired_return, desired_horizon, temperature=0.0)" in card


@pytest.mark.parametrize("option", ["--onnx", "--folder"])
def test_full_disk_leaves_an_earlier_export_unchanged(
    option: str, ended_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "agent.onnx" if option == "--onnx" else tmp_path / "agent"
    export(ended_run, option, place)
    files = sorted(path for path in tmp_path.rglob("*") if path.is_file())
    before = [path.read_bytes() for path in files]
    write = Path.write_bytes

    def fills_the_disk(path: Path, content: bytes) -> None:
        write(path, content[:10])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", fills_the_disk)
    with pytest.raises(ConfigError, match="No space left"):
        export(ended_run, option, place)
    monkeypatch.undo()
    assert sorted(path for path in tmp_path.rglob("*") if path.is_file()) == files
    assert [path.read_bytes() for path in files] == before


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_onnx_model_is_exported(ended_run: Path, tmp_path: Path) -> None:
    path = tmp_path / "agent.onnx"
    assert str(path) in export(ended_run, "--onnx", path)
    model = onnxruntime.InferenceSession(str(path))
    assert [i.name for i in model.get_inputs()] == ["observation", "command"]
    assert [o.name for o in model.get_outputs()] == ["logits"]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_invalid_exports_are_rejected(ended_run: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="nothing to export"):
        export(ended_run)
    with pytest.raises(ConfigError, match="is the directory of a run"):
        export(ended_run, "--folder", ended_run)
    with pytest.raises(ConfigError, match="--public needs --hub REPO_ID"):
        export(ended_run, "--onnx", tmp_path / "agent.onnx", "--public")
    with pytest.raises(ConfigError, match=r"agent\.bin: expected a name that ends with \.onnx"):
        export(tmp_path / "no run", "--onnx", tmp_path / "agent.bin")
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="choose a writable file"):
        export(ended_run, "--onnx", tmp_path / "file" / "agent.onnx")
    with pytest.raises(UdrlError, match="not kept"):
        export(ended_run, "--folder", tmp_path / "x", "--weights", "1")
