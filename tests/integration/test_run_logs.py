"""Logs for TensorBoard, Weights & Biases and MLflow, each read by its own library."""

import csv
import json
import os
import shutil
import struct
import subprocess
import sys
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import udrl
from udrl.errors import ConfigError, StoreError, UnsupportedEnvironment
from udrl_inspect.inspection import read_status, settings_of
from udrl_show.event_files import FOLDER
from udrl_show.run_log import Logged, RunLog
from udrl_show.run_logs import WRITERS, opened
from udrl_show.scalars import Scalar
from whole_run import TOY, Cli, arguments, wait_for

# Tests import mlflow and wandb themselves: together they take two seconds, in every process that
# collects tests.
if TYPE_CHECKING:
    from mlflow.entities import Run

#: (env steps, value) by tag.
Series = dict[str, list[tuple[int, float]]]


@pytest.fixture(autouse=True)
def _local_logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Keep all logs on this machine."""
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path}/mlflow.db")
    yield
    if (wandb := sys.modules.get("wandb")) is not None:
        wandb.teardown()


@pytest.fixture
def run_dir(ended_run: Path, tmp_path: Path) -> Path:
    """A copy of an ended run."""
    return Path(shutil.copytree(ended_run, tmp_path / "run"))


def log(run_dir: Path, *names: str, stopped: bool = False) -> list[str]:
    """Log a run as ``udrl train`` does; return the places of the logs."""
    status = read_status(run_dir)
    if stopped:
        status = msgspec.structs.replace(status, state="stopped", final_evaluation=None)
    with opened(names, run_dir) as logs:
        for one in logs:
            one.show(status)
    return [one.place for one in logs]


def event_files(run_dir: Path) -> Series:
    """Return the scalars that TensorBoard reads for a run."""
    log(run_dir, "tensorboard")
    found = EventAccumulator(str(run_dir / FOLDER), size_guidance={"scalars": 0})
    found.Reload()
    return {
        tag: [(event.step, event.value) for event in found.Scalars(tag)]
        for tag in found.Tags()["scalars"]
    }


def assert_same(found: Series, expected: Series) -> None:
    """Compare values; event files have single precision."""
    assert {tag: [step for step, _ in points] for tag, points in found.items()} == {
        tag: [step for step, _ in points] for tag, points in expected.items()
    }
    for tag, points in found.items():
        assert [v for _, v in points] == pytest.approx([v for _, v in expected[tag]], rel=1e-6)


def records(folder: Path) -> Iterator[Any]:
    """Yield the records of an offline run; its file is LevelDB's log after seven bytes."""
    from wandb.proto.wandb_internal_pb2 import Record  # type: ignore[attr-defined]

    (path,) = folder.glob("*.wandb")
    data, at, parts = path.read_bytes(), 7, b""
    while at + 7 <= len(data):
        if (left := 32768 - at % 32768) < 7:
            at += left
            continue
        _, size, kind = struct.unpack("<IHB", data[at : at + 7])
        parts += data[at + 7 : at + 7 + size]
        at += 7 + size
        if kind in (1, 4):  # a whole record, or its last part
            yield Record.FromString(parts)
            parts = b""


def values(items: Sequence[Any]) -> dict[str, Any]:
    return {item.key or ".".join(item.nested_key): json.loads(item.value_json) for item in items}


class OfflineRun:
    """An offline run of W&B; its file may be completed after ``finish`` has returned."""

    def __init__(self, folder: Path) -> None:
        self.runs: list[Any] = []
        self.series: Series = defaultdict(list)
        self.summary: dict[str, Any] = {}
        for record in records(folder):
            if record.HasField("run"):
                self.runs.append(record.run)
            if record.HasField("summary"):
                self.summary |= values(record.summary.update)
            if record.HasField("history"):
                row = values(record.history.item)
                for tag, value in row.items():
                    if "/" in tag:
                        self.series[tag].append((row["env_steps"], value))


def test_weights_and_biases_log_equals_the_event_files(run_dir: Path) -> None:
    (place,) = log(run_dir, "wandb")
    wait_for(lambda: "ended_because" in OfflineRun(Path(place)).summary, "the log to be complete")
    found = OfflineRun(Path(place))
    status = read_status(run_dir)
    run = found.runs[0]
    assert (run.run_id, run.project, run.display_name) == (status.run_id, "udrl", run_dir.name)
    config = {i.key: json.loads(i.value_json) for r in found.runs for i in r.config.update}
    assert settings_of(run_dir).items() <= config.items()
    assert found.summary["ended_because"] == status.ended_because
    assert_same(found.series, event_files(run_dir))


class ServedRun:
    """A run on W&B's server, which keeps its history when the run is resumed."""

    id, offline, url, dir = "", False, "https://wandb.example/run", "/"

    def __init__(self) -> None:
        self.summary: dict[str, Any] = {}
        self.rows: list[dict[str, Any]] = []
        self.options: list[dict[str, Any]] = []

    def init(self, **options: Any) -> "ServedRun":
        self.options.append(options)
        return self

    def define_metric(self, name: str, step_metric: str | None = None) -> None: ...

    def log(self, row: dict[str, Any]) -> None:
        self.rows.append(row)
        self.summary |= row

    def finish(self) -> None: ...


def truncate_metrics(run_dir: Path, share: float) -> str:
    """Truncate ``metrics.csv`` as if the run had been stopped; return the whole text."""
    path = run_dir / "metrics.csv"
    text = path.read_text()
    lines = text.splitlines(keepends=True)
    path.unlink()
    path.write_text("".join(lines[: int(share * len(lines))]))
    return text


def test_resumed_run_continues_at_weights_and_biases(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    served = ServedRun()
    monkeypatch.setattr("wandb.init", served.init)
    text = truncate_metrics(run_dir, 0.5)
    assert log(run_dir, "wandb", stopped=True) == [served.url]
    half = len(served.rows)
    assert half > 0
    assert "ended_because" not in served.summary
    (run_dir / "metrics.csv").write_text(text)
    for _ in range(2):  # the second call has nothing to add
        log(run_dir, "wandb")
        with (run_dir / "metrics.csv").open(newline="") as file:
            expected = [int(row["iteration"]) for row in csv.DictReader(file)]
        logged = [row["time/iterations"] for row in served.rows if "time/iterations" in row]
        assert logged == expected
        assert served.rows[-1]["eval/mean_reward"] == read_status(run_dir).final_evaluation.mean  # type: ignore[union-attr]
        assert sum("eval/mean_reward" in row for row in served.rows[-2:]) == 1
        assert served.summary["ended_because"] == read_status(run_dir).ended_because
    assert {(o["id"], o["resume"]) for o in served.options} == {
        (read_status(run_dir).run_id, "allow")
    }


def mlflow_run(place: str) -> tuple["Run", Series]:
    """Return the only run of the experiment, and its metrics."""
    import mlflow

    client = mlflow.MlflowClient()
    experiment = client.get_experiment_by_name("udrl")
    assert experiment is not None
    (run,) = client.search_runs([experiment.experiment_id])
    assert place.endswith(f"experiment udrl, run {run.info.run_id}")
    return run, {
        tag: [(m.step, m.value) for m in client.get_metric_history(run.info.run_id, tag)]
        for tag in run.data.metrics
    }


def test_mlflow_log_equals_the_event_files_after_resuming(run_dir: Path) -> None:
    text = truncate_metrics(run_dir, 0.5)
    run, found = mlflow_run(*log(run_dir, "mlflow", stopped=True))
    assert run.info.status == "KILLED"
    assert len(found["time/iterations"]) == len((run_dir / "metrics.csv").read_text().split()) - 1
    (run_dir / "metrics.csv").write_text(text)
    expected = event_files(run_dir)
    for _ in range(2):  # the second call has nothing to add
        run, found = mlflow_run(*log(run_dir, "mlflow"))
        assert_same(found, expected)
        assert (run.info.status, run.info.run_name) == ("FINISHED", run_dir.name)
        assert run.data.tags["udrl.ended_because"] == read_status(run_dir).ended_because
    assert run.data.params.keys() == settings_of(run_dir).keys()
    assert json.loads(run.data.params["hidden"]) == [16, 16]
    assert run.data.params["environment"] == "CartPole-v1"


def test_failing_log_does_not_end_the_training(
    tmp_path: Path, cli: Callable[..., Cli], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:9")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    run_dir = tmp_path / "run"
    started = cli(
        *arguments(TOY, 200, run_dir), "--in-process", "--log", "mlflow", "--log", "wandb"
    )
    code, _, err = started.finish(timeout=100)
    assert code == 0, err
    assert err.count("the log for mlflow failed, and the run continues without it: ") == 1
    assert "Connection refused" in err
    (folder,) = run_dir.glob("wandb/offline-run-*")
    assert f"wandb:            run/wandb/{folder.name}\n" in err
    assert "mlflow: " not in err.partition("learning curve:")[2]


def test_weights_and_biases_without_a_login_does_not_prompt(run_dir: Path, tmp_path: Path) -> None:
    script = (
        "import sys, pathlib, logging\n"
        "from udrl_inspect.inspection import read_status\n"
        "from udrl_show.run_logs import opened\n"
        "logging.basicConfig()\n"
        "run_dir = pathlib.Path(sys.argv[1])\n"
        "with opened(['wandb'], run_dir) as logs:\n"
        "    for _ in range(3):\n"
        "        logs[0].show(read_status(run_dir))\n"
        "print('the run continues')\n"
    )
    kept = {name: value for name, value in os.environ.items() if not name.startswith("WANDB_")}
    done = subprocess.run(
        [sys.executable, "-c", script, str(run_dir)], env=kept | {"HOME": str(tmp_path)},
        stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=100, check=True,
    )  # fmt: skip
    assert done.stdout == "the run continues\n"
    assert done.stderr.count("the log for wandb failed, and the run continues without it: ") == 1
    assert "No API key configured" in done.stderr


class HangingWriter:
    """A writer whose server does not respond."""

    place = ""

    def __init__(self) -> None:
        self.answers = threading.Event()

    def begin(self, run_id: str, settings: dict[str, Any], began: float) -> Logged:
        self.answers.wait(60)
        return Logged()

    def write(self, scalars: Sequence[Scalar]) -> None: ...

    def end(self, because: str) -> None: ...

    def close(self) -> None: ...


def test_hanging_log_is_abandoned(run_dir: Path, caplog: pytest.LogCaptureFixture) -> None:
    writer = HangingWriter()
    hanging = RunLog(run_dir, "stuck", writer)
    hanging.show(read_status(run_dir))
    hanging.finish()
    hanging.join(0.1)
    assert caplog.messages == ["the log for stuck is incomplete: it takes too long to write"]
    writer.answers.set()
    hanging.join(60)
    assert len(caplog.messages) == 1


@pytest.mark.parametrize(
    ("name", "module"),
    [("tensorboard", "tensorboard.compat.proto.event_pb2"), ("wandb", "wandb"),
     ("mlflow", "mlflow")],
)  # fmt: skip
def test_missing_extra_is_reported(
    name: str, module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ConfigError, match=rf'pip install "udrl\[{name}\]"'):
        WRITERS[name](tmp_path)


def test_refused_run_keeps_the_event_files_of_the_directory(run_dir: Path, tmp_path: Path) -> None:
    series = event_files(run_dir)
    before = sorted((run_dir / FOLDER).iterdir())
    with pytest.raises(StoreError, match="holds a run already"):
        udrl.train("CartPole-v1", run_dir=run_dir, log="tensorboard")
    assert sorted((run_dir / FOLDER).iterdir()) == before
    assert_same(event_files(run_dir), series)
    with pytest.raises(UnsupportedEnvironment):
        udrl.train("NoSuch-v0", run_dir=tmp_path / "new", log="tensorboard")
    assert not (tmp_path / "new").exists()


def test_unwritable_event_files_do_not_end_the_training(
    run_dir: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (run_dir / FOLDER).write_text("in the way")
    assert log(run_dir, "tensorboard") == [""]
    (message,) = caplog.messages
    assert "the log for tensorboard failed, and the run continues without it" in message
    assert "make it a writable folder" in message


def test_log_that_cannot_be_opened_is_rejected_before_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_dir = tmp_path / "run"
    with pytest.raises(ConfigError, match="log 'tensorbord': expected one of tensorboard, wandb"):
        udrl.train("Figure2-v0", run_dir=run_dir, log="tensorbord")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "carrier-pigeon://home")
    with pytest.raises(ConfigError, match=r"carrier-pigeon://home: .*set MLFLOW_TRACKING_URI to"):
        udrl.train("Figure2-v0", run_dir=run_dir, log=["mlflow"])
    assert not run_dir.exists()
