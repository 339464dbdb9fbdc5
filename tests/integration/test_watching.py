"""Monitoring with TensorBoard and Prometheus, read by their own libraries."""

import csv
import re
import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.metadata import SESSION_START_INFO_TAG
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from udrl_inspect.inspection import read_status
from udrl_show.event_files import FOLDER
from udrl_show.scalars import DERIVED_TAGS, EVALUATION_TAGS, TAGS
from whole_run import SMALL, Cli, arguments, free_port, live_status, wait_for


def read(run_dir: Path) -> dict[str, list[tuple[int, float]]]:
    """Return (env steps, value) by tag, as read by TensorBoard."""
    found = EventAccumulator(str(run_dir / FOLDER), size_guidance={"scalars": 0})
    found.Reload()
    return {
        tag: [(event.step, event.value) for event in found.Scalars(tag)]
        for tag in found.Tags()["scalars"]
    }


def hyperparameters(run_dir: Path) -> dict[str, object]:
    """Return the hyperparameters of TensorBoard's HPARAMS page."""
    found = EventAccumulator(str(run_dir / FOLDER))
    found.Reload()
    content = found.SummaryMetadata(SESSION_START_INFO_TAG).plugin_data.content
    values = HParamsPluginData.FromString(content).session_start_info.hparams
    return {name: getattr(v, str(v.WhichOneof("kind"))) for name, v in values.items()}


def metrics(run_dir: Path) -> list[dict[str, str]]:
    with (run_dir / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_event_files_equal_the_metrics(cli: Callable[..., Cli], tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    for budget in (3000, 4500):
        cli(
            *arguments(SMALL, budget, run_dir), "--resume", "--log", "tensorboard", "--in-process"
        ).status()
        scalars, rows = read(run_dir), metrics(run_dir)
        assert set(scalars) == {*TAGS, *EVALUATION_TAGS, *DERIVED_TAGS}
        # Iterations may be complete at the same time; between them there is no speed.
        walls = [0.0, *(float(r["wall_s"]) for r in rows)]
        timed = [
            int(row["env_steps"]) for row, was in zip(rows, walls[:-1], strict=True)
            if float(row["wall_s"]) > was
        ]  # fmt: skip
        assert [step for step, _ in scalars.pop("time/fps")] == timed
        assert timed
        evaluated = SMALL["eval_episodes"]
        explored = [int(r["commands"]) - (evaluated if r["eval_mean"] else 0) for r in rows]
        assert explored[0] == SMALL["n_warm_up_episodes"]
        assert set(explored[1:]) == {SMALL["n_episodes_per_iter"]}
        totals = [0, *(int(r["env_steps"]) for r in rows)]
        lengths = [(b - a) / n for a, b, n in zip(totals, totals[1:], explored, strict=False)]
        assert [value for _, value in scalars["rollout/ep_len_mean"]] == pytest.approx(lengths)
        assert [step for step, _ in scalars.pop("rollout/ep_len_mean")] == totals[1:]
        assert hyperparameters(run_dir)["learning_rate"] == SMALL["learning_rate"]
        assert hyperparameters(run_dir)["hidden"] == "[16, 16]"
        assert hyperparameters(run_dir)["max_env_steps"] == budget
        last = read_status(run_dir).final_evaluation
        assert last is not None
        for tag in ("eval/mean_reward", "eval/ci95_low", "eval/ci95_high"):
            assert scalars[tag].pop()[0] == last.env_steps
        for tags, steps in ((TAGS, "env_steps"), (EVALUATION_TAGS, "eval_at_env_steps")):
            for tag, column in tags.items():
                expected = [(int(r[steps]), float(r[column])) for r in rows if r[column]]
                assert [step for step, _ in scalars[tag]] == [step for step, _ in expected]
                for (_, value), (_, wanted) in zip(scalars[tag], expected, strict=True):
                    assert abs(value - wanted) <= 1e-6 * abs(wanted) + 1e-9
        assert len(list((run_dir / FOLDER).iterdir())) == 1


def scrape(port: int) -> dict[str, float]:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
            text = answer.read().decode()
    except OSError:
        return {}
    return {
        s.name: s.value for f in text_string_to_metric_families(text) for s in f.samples
        if not s.labels
    }  # fmt: skip


def test_prometheus_scrapes_a_live_run(cli: Callable[..., Cli], tmp_path: Path) -> None:
    port, run_dir = free_port(), tmp_path / "run"
    cli(*arguments(SMALL, 10_000_000, run_dir), "--metrics-port", str(port), "--actors", "1")
    wait_for(lambda: scrape(port).get("udrl_iteration", 0) > 2, "some iterations")
    first = scrape(port)["udrl_env_steps_total"]
    wait_for(lambda: scrape(port)["udrl_env_steps_total"] > first, "more env steps")
    assert scrape(port)["udrl_actors"] == 1

    other = cli("metrics", str(run_dir), "--port", "0").process
    assert other.stdout is not None
    line = re.fullmatch(r"metrics: http://127\.0\.0\.1:(\d+)/metrics\n", other.stdout.readline())
    assert line is not None
    assert scrape(int(line[1]))["udrl_actors"] == 1


def test_exporter_outlives_the_run(cli: Callable[..., Cli], tmp_path: Path) -> None:
    endpoint, run_dir = f"tcp/127.0.0.1:{free_port()}", tmp_path / "run"
    training = cli(*arguments(SMALL, 10_000_000, run_dir), "--listen", endpoint, "--actors", "1")
    wait_for(lambda: (s := live_status(run_dir)) and s.iteration > 0, "an iteration")
    exporter = cli("metrics", "--connect", endpoint, "--port", "0").process
    assert exporter.stdout is not None
    port = int(exporter.stdout.readline().split(":")[-1].split("/")[0])
    assert scrape(port)["udrl_up"] == 1
    training.process.terminate()
    training.finish()
    wait_for(lambda: scrape(port).get("udrl_up") == 0, "the run to be unreachable")
