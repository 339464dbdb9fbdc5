"""A run's status as metrics for Prometheus; each is explained in ``docs/metrics.md``."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from udrl.errors import ConfigError
from udrl_proto.messages import Message
from udrl_proto.reports import Status

_STATES = ("running", "finishing", "ended", "failed", "stopped")

#: Name, status field and description of each number of a run, and whether it is a counter.
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
    (
        "udrl_weights_lag_seconds",
        "weights_lag_s",
        "From a version's delivery to its first command.",
        False,
    ),
    ("udrl_loss_nats", "loss", "Training loss of the newest version.", False),
    ("udrl_env_failures", "env_failures", "Failures that actors reported.", True),
    ("udrl_useful_concurrency", "useful_concurrency", "Episodes that can run at once.", False),
    ("udrl_exact", "exact", "1: the result depends only on the configuration.", False),
)

#: The same of each actor.
_ACTOR_NUMBERS: tuple[tuple[str, str, str, bool], ...] = (
    (
        "udrl_actor_env_steps_per_second",
        "env_steps_per_s",
        "Env steps per second, as reported by the actor.",
        False,
    ),
    ("udrl_actor_weights_lag_versions", "weights_lag", "Versions the actor is behind.", False),
    ("udrl_actor_reruns", "reruns", "Commands that had been assigned before.", True),
    ("udrl_actor_failures", "failures", "Commands that failed.", True),
    ("udrl_actor_last_seen_seconds", "last_seen_s", "Time since its last message.", False),
)


class _Metric(NamedTuple):
    """A metric of a run.

    Attributes:
        name: its name in Prometheus.
        about: its description.
        labels: names of its labels.
        rows: values of the labels, and the number; numbers that are None are not exported.
        is_counter: whether it is a counter, not a gauge.
    """

    name: str
    about: str
    labels: tuple[str, ...]
    rows: Sequence[tuple[Sequence[str], float | None]]
    is_counter: bool = False


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

        for metric in _metrics(self._get()):
            kind = CounterMetricFamily if metric.is_counter else GaugeMetricFamily
            family = kind(metric.name, metric.about, labels=metric.labels)
            for values, number in metric.rows:
                if number is not None:
                    family.add_metric(values, float(number))
            yield family


def _metrics(status: Status | None) -> Iterator[_Metric]:
    yield _single("udrl_up", "1: the status is known.", status is not None)
    if status is None:
        return
    for name, field, about, is_counter in _NUMBERS:
        if (number := getattr(status, field)) is not None:
            yield _single(name, about, number, is_counter)
    run = (status.run_id, status.environment)
    yield _Metric(
        "udrl_run_info", "Run id and environment; always 1.", ("run_id", "environment"), [(run, 1)]
    )
    states = [((state,), state == status.state) for state in _STATES]
    yield _Metric("udrl_state", "1 for the current state of the run.", ("state",), states)
    for name, found in (
        ("udrl_eval_return", status.evaluation),
        ("udrl_final_eval_return", status.final_evaluation),
    ):
        stats = _fields(found, ("mean", "std", "ci95_low", "ci95_high")) if found else []
        yield _Metric(name, "Returns of the evaluation.", ("stat",), stats)
    returns = _fields(status.buffer, ("min", "mean", "max"), prefix="return_")
    yield _Metric("udrl_replay_return", "Returns in the replay buffer.", ("stat",), returns)
    yield _single("udrl_replay_episodes", "Episodes in the replay buffer.", status.buffer.episodes)
    for name, ledger in (("udrl_commands", status.commands), ("udrl_episodes", status.episodes)):
        counts = _fields(ledger, ledger.__struct_fields__)
        yield _Metric(name, "Conservation ledger.", ("state",), counts)
    yield _single("udrl_actors", "Connected actors.", len(status.actors))
    for name, field, about, is_counter in _ACTOR_NUMBERS:
        numbers = [((a.id, a.host), getattr(a, field)) for a in status.actors]
        yield _Metric(name, about, ("actor", "host"), numbers, is_counter)
    waits = [((wait.who, wait.on), wait.seconds) for wait in status.waiting]
    yield _Metric("udrl_waiting_seconds", "Waiting time of a service.", ("who", "for"), waits)
    yield _single("udrl_quarantined_actors", "Quarantined actors.", len(status.quarantined))


def _single(name: str, about: str, number: float, is_counter: bool = False) -> _Metric:
    """Return a metric without labels."""
    return _Metric(name, about, (), [((), number)], is_counter)


def _fields(
    message: Message, names: Iterable[str], prefix: str = ""
) -> list[tuple[tuple[str], float | None]]:
    """Return a row for each of a message's fields, labelled with its name without the prefix."""
    return [((name,), getattr(message, prefix + name)) for name in names]


class Exporter:
    """Serves metrics to Prometheus over HTTP.

    Args:
        get: returns the status, as for :class:`StatusCollector`.
        host: address to listen on.
        port: port to listen on; 0 = any free port.

    Attributes:
        port: the port that is listened on.
        address: the address of the metrics.

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
        except (OSError, UnicodeError) as error:  # UnicodeError: not a host name
            reason = error.strerror if isinstance(error, OSError) else error
            raise ConfigError(
                f"metrics on {host}, port {port}: {reason}; choose an address of this "
                f"machine and a free port, or port 0"
            ) from error
        self.port: int = self._server.server_port
        shown = f"[{host}]" if ":" in host else host
        self.address = f"http://{shown}:{self.port}/metrics"

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
