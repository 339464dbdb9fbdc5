"""Every study from the command line, on a tiny budget, interrupted and resumed."""

import csv
import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from udrl.config import Config, build, flat, read_toml
from udrl.errors import RunFailed
from udrl_experiments.jobs import Job
from udrl_experiments.study_progress import job_progress
from udrl_inspect.inspection import read_status
from whole_run import Cli, reference, small, wait_for

TINY = {
    "eval_every": 1000, "eval_episodes": 3, "n_warm_up_episodes": 5, "n_episodes_per_iter": 4,
    "n_updates_per_iter": 2, "batch_size": 32, "hidden": [8, 8],
}  # fmt: skip
SETTINGS = [word for k, v in TINY.items() for word in ("--set", f"{k}={json.dumps(v)}")]
#: For a search, which draws the other settings.
SEARCH = ["--set", "eval_every=1000", "--set", "eval_episodes=3"]
STEPS = 2000


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def study(cli: Callable[..., Cli]) -> Callable[..., Path]:
    """Run a study, one run at a time, and return its folder."""

    def conduct(name: str, *arguments: str, root: Path, timeout: float = 110) -> Path:
        settings = SEARCH if name == "search" else SETTINGS
        started = cli("study", name, "--folder", str(root), "--max-env-steps", str(STEPS),
                      *settings, *arguments)  # fmt: skip
        code, _, error = started.finish(timeout)
        assert code == 0, error
        return root / name

    return conduct


def runs_of(root: Path, algorithm: str) -> list[Path]:
    return sorted((root / "runs").glob(f"{algorithm}-*"))


@pytest.mark.slow
def test_comparison_is_interrupted_and_resumed(
    cli: Callable[..., Cli], study: Callable[..., Path], tmp_path: Path
) -> None:
    whole = ("--seeds", "1-2", "--side-by-side", "1")
    begun = cli("study", "lander", "--folder", str(tmp_path), "--max-env-steps", str(STEPS),
                *SETTINGS, *whole)  # fmt: skip
    wait_for(lambda: list(tmp_path.glob("runs/udrl-*/done.json")), "the first run", 60)
    begun.process.send_signal(signal.SIGTERM)
    code, _, error = begun.finish()
    assert code == 128 + signal.SIGTERM, error
    assert "--resume" in error
    (first,) = tmp_path.glob("runs/udrl-*/done.json")
    done_at = first.stat().st_mtime_ns

    code, _, error = cli("study", "lander", "--folder", str(tmp_path), *SETTINGS, *whole).finish()
    assert code == 2
    assert "already contains a study; pass --resume to resume it" in error
    code, _, error = cli("study", "lander", "--folder", str(tmp_path), "--resume").finish()
    assert code == 2
    assert "which is not in this one; pass the original options" in error

    folder = study("lander", *whole, "--resume", root=tmp_path)
    assert first.stat().st_mtime_ns == done_at
    table = rows(folder / "evaluations.csv")
    assert {(r["algorithm"], r["seed"]) for r in table} == {
        (algorithm, seed) for algorithm in ("UDRL", "DQN", "A2C") for seed in "12"
    }
    curves = rows(folder / "curves.csv")
    assert {(r["algorithm"], r["env_steps"], r["seeds"]) for r in curves} >= {
        (algorithm, "1000", "2") for algorithm in ("UDRL", "DQN", "A2C")
    }
    for suffix in (".png", ".svg"):
        assert (folder / f"learning-curves{suffix}").stat().st_size > 10_000
    about = json.loads((folder / "study.json").read_text())
    assert len(about["runs"]) == 6
    assert about["versions"]["torch"]
    assert len(rows(folder / "reached.csv")) == 6 * 3


@pytest.mark.slow
def test_run_of_a_study_equals_a_run_with_its_settings(
    study: Callable[..., Path], tmp_path: Path
) -> None:
    study("sparse", "--algorithm", "UDRL", "--seeds", "3", "--set", "lead=0", root=tmp_path)
    (folder,) = runs_of(tmp_path, "udrl")
    config: dict[str, Any] = json.loads((folder / "job.json").read_text())["config"]
    expected = reference(build(Config, config), STEPS)
    *held, final = rows(folder / "evaluations.csv")
    assert [float(r["mean"]) for r in held] == [e.mean for e in expected.evaluations.values()]
    assert int(final["env_steps"]) == expected.env_steps


def test_progress_of_an_unfinished_run_is_read_from_its_store(
    ended_run: Path, tmp_path: Path
) -> None:
    status = read_status(ended_run)
    job = Job(algorithm="UDRL", settings=flat(small()), max_env_steps=2 * status.env_steps)
    job.folder(tmp_path).mkdir(parents=True)
    (job.folder(tmp_path) / "run").symlink_to(ended_run)
    found = job_progress(job, tmp_path)
    assert status.evaluation is not None
    assert found == (job, "unfinished", status.env_steps, status.wall_s, status.evaluation.mean)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_studies_share_their_runs(
    study: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = ("--seeds", "1")
    study("sparse", *one, "--algorithm", "UDRL", root=tmp_path)
    assert len(runs_of(tmp_path, "udrl")) == 1

    folder = study("sensitivity", *one, "--task", "sparse", "--episodes", "2", root=tmp_path)
    assert len(runs_of(tmp_path, "udrl")) == 1
    table = rows(folder / "LunarLanderSparse.csv")
    assert [float(r["desired_return"]) for r in table] == list(range(-150, 301, 25))
    assert (folder / "LunarLanderSparse.svg").exists()

    folder = study("lead", *one, "--task", "sparse", root=tmp_path, timeout=200)
    assert {r["variant"] for r in rows(folder / "evaluations.csv")} == {
        f"lead {n}" for n in (0, 1, 2, 4, 8)
    }
    assert (folder / "learning-curves-wall-time.png").exists()
    assert len(runs_of(tmp_path, "udrl")) == 1
    assert len(runs_of(folder, "udrl")) == 5

    folder = study("segments", *one, root=tmp_path, timeout=200)
    assert {r["variant"] for r in rows(folder / "LunarLander" / "evaluations.csv")} == {
        "trailing", "all"
    }  # fmt: skip
    assert len(runs_of(tmp_path, "udrl")) == 1 + 3

    (tmp_path / "patient.py").write_text(
        "class Patient:\n"
        "    def __init__(self, config): pass\n"
        "    def __call__(self, best, u): return best[-1].episode_return, 2 * best[-1].length\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    own = ("--strategy", "patient:Patient")
    folder = study("commands", *one, "--task", "sparse", *own, root=tmp_path, timeout=200)
    assert {r["variant"] for r in rows(folder / "evaluations.csv")} == {
        "uniform", "ranked", "patient:Patient"
    }  # fmt: skip
    assert len(runs_of(tmp_path, "udrl")) == 4 + 2


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_search_is_extended_with_more_configurations(
    study: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = Path("studies")  # relative to the working directory, like the default
    monkeypatch.chdir(tmp_path)
    arguments = ("--task", "lander", "--seeds", "1", "--algorithm", "A2C")
    folder = study("search", *arguments, "--configurations", "1", root=here, timeout=140)
    assert len(rows(folder / "scores.csv")) == 1
    (first,) = (run / "done.json" for run in runs_of(here, "a2c"))
    done_at = first.stat().st_mtime_ns
    more = ("--configurations", "2", "--resume")
    folder = study("search", *arguments, *more, root=here, timeout=140)
    assert all(float(r["score"]) < 0 for r in rows(folder / "scores.csv"))
    assert len(runs_of(here, "a2c")) == 2
    assert first.stat().st_mtime_ns == done_at
    assert (folder / "a2c-LunarLander-v3.toml").exists()


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_search_over_a_custom_space(study: Callable[..., Path], tmp_path: Path) -> None:
    space = tmp_path / "mine.toml"
    space.write_text(
        "[networks]\nhidden = [[8], [16]]\n[UDRL]\nbatch_size = [32]\nn_updates_per_iter = [2]\n"
        "[PPO]\nn_steps = [100]\n"
    )
    arguments = ("CartPole-v1", "--space", str(space), "--configurations", "1")
    study("search", *arguments, root=tmp_path, timeout=200)
    folder = tmp_path / "search-CartPole-v1"
    assert [r["algorithm"] for r in rows(folder / "scores.csv")] == ["UDRL", "PPO"]
    assert all(float(r["score"]) > 0 for r in rows(folder / "scores.csv"))
    best = read_toml(folder / "udrl-CartPole-v1.toml")
    assert (best["batch_size"], best["n_updates_per_iter"]) == (32, 2)


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_failed_run_of_a_search_is_reported_in_one_line(
    cli: Callable[..., Cli], tmp_path: Path
) -> None:
    space = tmp_path / "mine.toml"
    # The warm-up exceeds the budget of the run.
    space.write_text("[UDRL]\nn_warm_up_episodes = [1000]\nbatch_size = [32, 33]\n")
    code, output, error = cli(
        "study", "search", "CartPole-v1", "--space", str(space), "--folder", str(tmp_path),
        "--configurations", "1", "--max-env-steps", str(STEPS), *SEARCH,
    ).finish(200)  # fmt: skip
    assert code == RunFailed.exit_code
    (run,) = runs_of(tmp_path, "udrl")
    described = "UDRL configuration 0, CartPole-v1, seed 1: 2,000 env steps"
    cause = f"the run in {run} ended without an evaluation within 2,000 env steps; raise "
    lines = error.splitlines()
    assert lines[0].startswith("1 runs on Ray Tune")
    assert lines[1] == described
    assert lines[2].startswith(f"failed: {described}: {cause}")
    assert lines[3].startswith(f"udrl: error: no run succeeded; the first failed: {cause}")
    assert (output, len(lines)) == ("", 4)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_take_cover_study(study: Callable[..., Path], tmp_path: Path) -> None:
    small = ("--set", "max_episode_steps=60", "--set", "convolutions=[4, 4, 4, 4]")
    folder = study("takecover", "--seeds", "1", *small, root=tmp_path, timeout=500)
    assert {r["algorithm"] for r in rows(folder / "evaluations.csv")} == {"UDRL", "DQN", "A2C"}
