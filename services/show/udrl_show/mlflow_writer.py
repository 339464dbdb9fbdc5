"""MLflow."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from udrl.errors import ConfigError
from udrl_show.run_log import Logged
from udrl_show.scalars import Scalar

#: Tags: the run's id here, by which a resumed run is found; why it ended.
_RUN_ID, _ENDED = "udrl.run_id", "udrl.ended_because"
#: Maximum number of metrics, and of parameters, that a server accepts at once.
_MOST_METRICS, _MOST_PARAMETERS = 1000, 100


class MlflowWriter:
    """A run in MLflow, whose steps are env steps.

    ``MLFLOW_TRACKING_URI`` names the server or database, ``MLFLOW_EXPERIMENT_NAME`` the experiment,
    by default ``udrl``.

    Args:
        run_dir: the run's directory.

    Raises:
        ConfigError: the extra is not installed, or MLflow cannot use its tracking URI.
    """

    def __init__(self, run_dir: Path) -> None:
        try:
            import mlflow
        except ModuleNotFoundError as error:
            raise ConfigError(
                'MLflow needs mlflow-skinny; install it with: pip install "udrl[mlflow]"'
            ) from error
        # By default MLflow retries for minutes before it reports that a server is unreachable.
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "3")
        uri = mlflow.get_tracking_uri()
        try:
            self._client = mlflow.MlflowClient()
        except mlflow.MlflowException as error:
            raise ConfigError(
                f"MLflow cannot use {uri}: {error}; set MLFLOW_TRACKING_URI to a server or to "
                f"sqlite:///FILE"
            ) from error
        self.place = ""
        self._uri = uri
        self._name = run_dir.name
        self._began = 0.0
        self._is_ended = False
        self._id = ""

    def begin(self, run_id: str, settings: dict[str, Any], began: float) -> Logged:
        """Begin or continue the run. Parameters do not change once they are there."""
        from mlflow.entities import Param

        name = os.environ.get("MLFLOW_EXPERIMENT_NAME", "udrl")
        experiment = self._client.get_experiment_by_name(name)
        where = experiment.experiment_id if experiment else self._client.create_experiment(name)
        found = self._client.search_runs([where], f"tags.`{_RUN_ID}` = '{run_id}'", max_results=1)
        run = next(iter(found), None) or self._client.create_run(
            where, start_time=round(1000 * began), tags={_RUN_ID: run_id}, run_name=self._name
        )
        self._id, self._began = run.info.run_id, began
        self.place = f"{self._uri}, experiment {name}, run {self._id}"
        self._is_ended = run.info.status == "FINISHED"
        self._client.update_run(self._id, status="RUNNING")
        new = [
            Param(name, value if isinstance(value, str) else json.dumps(value))
            for name, value in settings.items()
            if name not in run.data.params
        ]
        for some in _batched(new, _MOST_PARAMETERS):
            self._client.log_batch(self._id, params=some)
        return Logged(int(run.data.metrics.get("time/iterations", -1)), self._is_ended)

    def write(self, scalars: Sequence[Scalar]) -> None:
        """Write scalars."""
        from mlflow.entities import Metric

        self._is_ended = False
        metrics = [
            Metric(tag, value, round(1000 * (self._began + wall_s)), env_steps)
            for tag, value, env_steps, wall_s in scalars
        ]
        for some in _batched(metrics, _MOST_METRICS):
            self._client.log_batch(self._id, metrics=some)

    def end(self, because: str) -> None:
        """Say in a tag why the run ended."""
        self._is_ended = True
        self._client.set_tag(self._id, _ENDED, because)

    def close(self) -> None:
        """Mark the run as finished or, if it can be resumed, as killed."""
        if self._id:
            self._client.set_terminated(self._id, "FINISHED" if self._is_ended else "KILLED")


def _batched(values: Sequence[Any], size: int) -> list[Sequence[Any]]:
    return [values[i : i + size] for i in range(0, len(values), size)]
