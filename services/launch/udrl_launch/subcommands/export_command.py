"""``udrl export``."""

from pathlib import Path

import click

from udrl.errors import ConfigError
from udrl.file_endings import check_ending
from udrl_inspect.agents import load_agent
from udrl_inspect.exporting import export_buffer, export_folder, export_model, export_to_hub
from udrl_inspect.hub import HUB_SCHEME
from udrl_inspect.obedience_report import report_of_agent
from udrl_launch.subcommands.options import FILE, FOLDER, RUN_DIR, WEIGHTS, version


@click.command()
@click.argument("run_dir", type=RUN_DIR)
@click.option(
    "--folder", type=FOLDER, metavar="DIR",
    help="Write the agent for udrl.load(DIR): weights, settings and a model card.",
)  # fmt: skip
@click.option(
    "--onnx", type=FILE, metavar="FILE",
    help="Write the agent as an ONNX model. Inputs: observation (one for each part of a Dict or "
    "Tuple) and command (desired return, desired horizon). Output: logits.",
)  # fmt: skip
@click.option(
    "--hub", "repo_id", metavar="REPO_ID",
    help="Upload the agent to the Hugging Face Hub, e.g. OWNER/NAME: weights, ONNX model, settings "
    "and model card. A new repository is private.",
)  # fmt: skip
@click.option("--public", is_flag=True, help="With --hub: upload to a public repository.")
@click.option(
    "--minari", metavar="NAME",
    help="Write the replay buffer as a Minari dataset, e.g. LunarLander/mine-v0.",
)  # fmt: skip
@WEIGHTS
def export(
    run_dir: Path,
    folder: Path | None,
    onnx: Path | None,
    repo_id: str | None,
    public: bool,
    minari: str | None,
    weights: str,
) -> int:
    """Export a run's agent or its episodes.

    Example: udrl export runs/mine --folder my-agent --onnx my-agent.onnx
    """
    if folder is None and onnx is None and repo_id is None and minari is None:
        raise ConfigError(
            "nothing to export: give --folder DIR, --onnx FILE, --hub REPO_ID or --minari NAME"
        )
    if public and repo_id is None:
        raise ConfigError("--public needs --hub REPO_ID")
    if onnx is not None:
        check_ending(onnx, (".onnx",))
    if minari is not None:
        click.echo(f"dataset: {minari}, {export_buffer(run_dir, minari)} episodes")
    if folder is None and onnx is None and repo_id is None:
        return 0
    agent = load_agent(run_dir, version(weights))
    if folder is not None:
        export_folder(agent, run_dir, folder)
        click.echo(f'folder: {folder}; in Python: udrl.load("{folder}")')
    if onnx is not None:
        export_model(agent, onnx)
        click.echo(f"ONNX model: {onnx}")
    if repo_id is not None:
        url = export_to_hub(agent, run_dir, repo_id, public=public)
        click.echo(f'Hub: {url}; in Python: udrl.load("{HUB_SCHEME}{repo_id}")')
    if (folder or repo_id) and report_of_agent(agent, run_dir) is None:
        click.echo(
            "The model card does not say which returns this agent can obtain. Measure them "
            f"and export again, with: udrl obedience {run_dir} --weights {agent.version}",
            err=True,
        )
    return 0
