"""A run's status as metrics for Prometheus; each is explained in ``docs/metrics.md``."""

from collections.abc import Callable, Iterator
from typing import Any

from udrl.errors import ConfigError
from udrl_proto.reports import EvaluationStatus, Status

STATES = ("running", "finishing", "ended", "failed", "stopped")

#: Name, status field and description of each metric, and whether it is a counter.
_NUMBERS: tuple[tuple[str, str, str, bool], ...] = (
    ("udrl_iteration", "iteration", "Last completed iteration.", False),
    ("udrl_env_steps", "env_steps", "Steps of warm-up and exploratory episodes.", True),
    ("udrl_eval_env_steps", "eval_env_steps", "Steps of evaluation episodes.", True),
    ("udrl_env_steps_per_second", "env_steps_per_s", "Env steps per second, last 10 s.", False),
    ("udrl_max_env_steps", "max_env_steps", "Budget of env steps.", False),
    ("udrl_wall_seconds", "wall_s", "Running time.", True),
    ("udrl_time_left_seconds", "time_left_s", "Time until the budget is spent.", False),
    ("udrl_weights_version", "weights_version", "Newest weights version.", False),
    ("udrl_weights_lag_versions", "weights_lag", "Versions the slowest actor is behind.", False),
    ("udrl_weights_lag_seconds", "weights_lag_s", "From a version to its first command.", False),
    ("udrl_loss_nats", "loss", "Training loss of the newest version.", False),
    ("udrl_env_failures", "env_failures", "Failures that actors reported.", True),
    ("udrl_useful_concurrency", "useful_concurrency", "Episodes that can run at once.", False),
    ("udrl_exact", "exact", "1: the result depends only on the configuration.", False),
)


class StatusCollector:
    """Collects a status for Prometheus.

    Args:
        get: returns the status. If it returns None, only ``udrl_up`` is exported, as 0.
    """

    def __init__(self, get: Callable[[], Status | None]) -> None:
        self._get = get

    def describe(self) -> list[Any]:
        """Return nothing, because the metrics depend on the run."""
        return []

    def collect(self) -> Iterator[Any]:
        """Yield the current metrics of the run."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        def labelled(
            name: str,
            about: str,
            labels: list[str],
            rows: list[tuple[list[str], float | None]],
            *,
            grows: bool = False,
        ) -> Any:
            family = (CounterMetricFamily if grows else GaugeMetricFamily)(
                name, about, labels=labels
            )
            for values, number in rows:
                if number is not None:
                    family.add_metric(values, number)
            return family

        status = self._get()
        yield GaugeMetricFamily(
            "udrl_up", "1: the status is known.", value=float(status is not None)
        )
        if status is None:
            return
        for name, attribute, about, grows in _NUMBERS:
            number = getattr(status, attribute)
            if number is not None:
                kind = CounterMetricFamily if grows else GaugeMetricFamily
                yield kind(name, about, value=float(number))
        yield labelled(
            "udrl_run_info", "Run id and environment; always 1.", ["run_id", "environment"],
            [([status.run_id, status.environment], 1.0)],
        )  # fmt: skip
        yield labelled(
            "udrl_state", "1 for the current state of the run.", ["state"],
            [([s], float(s == status.state)) for s in STATES],
        )  # fmt: skip
        for name, found in (
            ("udrl_eval_return", status.evaluation),
            ("udrl_final_eval_return", status.final_evaluation),
        ):
            yield labelled(name, "Returns of the evaluation.", ["stat"], _stats(found))
        held = status.buffer
        yield labelled(
            "udrl_replay_return", "Returns in the replay buffer.", ["stat"],
            [(["min"], held.return_min), (["mean"], held.return_mean), (["max"], held.return_max)],
        )  # fmt: skip
        yield GaugeMetricFamily(
            "udrl_replay_episodes", "Episodes in the replay buffer.", value=held.episodes
        )
        for name, ledger in (
            ("udrl_commands", status.commands),
            ("udrl_episodes", status.episodes),
        ):
            fields = ledger.__struct_fields__
            yield labelled(
                name, "Conservation ledger.", ["state"],
                [([field], float(getattr(ledger, field))) for field in fields],
            )  # fmt: skip
        actors = status.actors
        yield GaugeMetricFamily("udrl_actors", "Connected actors.", value=len(actors))
        for name, attribute, about, grows in (
            (
                "udrl_actor_env_steps_per_second",
                "env_steps_per_s",
                "Env steps per second, as reported by the actor.",
                False,
            ),
            ("udrl_actor_weights_lag_versions", "weights_lag", "Versions behind.", False),
            ("udrl_actor_reruns", "reruns", "Commands that had been assigned before.", True),
            ("udrl_actor_failures", "failures", "Commands that failed.", True),
            ("udrl_actor_last_seen_seconds", "last_seen_s", "Time since its last message.", False),
        ):
            yield labelled(
                name, about, ["actor", "host"],
                [([a.id, a.host], float(getattr(a, attribute))) for a in actors],
                grows=grows,
            )  # fmt: skip
        yield labelled(
            "udrl_waiting_seconds", "Waiting time of a service.", ["who", "for"],
            [([w.who, w.on], w.seconds) for w in status.waiting],
        )  # fmt: skip
        yield GaugeMetricFamily(
            "udrl_quarantined_actors", "Quarantined actors.", value=len(status.quarantined)
        )


def _stats(found: EvaluationStatus | None) -> list[tuple[list[str], float | None]]:
    names = ("mean", "std", "ci95_low", "ci95_high")
    return [([name], getattr(found, name)) for name in names] if found is not None else []


class Exporter:
    """Serves metrics to Prometheus over HTTP.

    Args:
        get: returns the status, as for :class:`StatusCollector`.
        host: address to listen on.
        port: port to listen on; 0 = any free port.

    Attributes:
        port: the port that is listened on.

    Raises:
        ConfigError: the extra is not installed, or the address cannot be used.
    """

    def __init__(self, get: Callable[[], Status | None], host: str, port: int) -> None:
        try:
            from prometheus_client import CollectorRegistry, start_http_server
        except ModuleNotFoundError as error:
            raise ConfigError(
                'metrics need prometheus_client; install it with: pip install "udrl[metrics]"'
            ) from error
        registry = CollectorRegistry()
        registry.register(StatusCollector(get))
        try:
            self._server, self._thread = start_http_server(port, host, registry)
        except OSError as error:
            raise ConfigError(
                f"metrics on {host}, port {port}: {error.strerror}; choose an address of this "
                f"machine and a free port, or port 0"
            ) from error
        self.port: int = self._server.server_port

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
