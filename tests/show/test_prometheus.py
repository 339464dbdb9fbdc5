"""Metrics for Prometheus, read by its own parser, and the dashboard's queries."""

import json
import re
import urllib.request
from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec
import pytest
from prometheus_client.parser import text_string_to_metric_families

from tests.show.test_display import STATUS
from udrl.errors import ConfigError
from udrl_launch.training_run import Watchers
from udrl_proto.reports import ActorStatus, Quarantined, Status
from udrl_show.prometheus import Exporter

ROOT = Path(__file__).parents[2]
FULL = msgspec.structs.replace(
    STATUS,
    actors=(
        ActorStatus(id="actor-1", host="here", environments=16, env_steps_per_s=500.5,
                    weights_version=5, weights_lag=1, running=3, reruns=2, failures=1,
                    last_seen_s=0.5),
    ),
    quarantined=(Quarantined(id="wrong_actor", why="a false episode"),),
    final_evaluation=STATUS.evaluation,
)  # fmt: skip


def scraped(status: Status | None) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    with closing(Exporter(lambda: status, "127.0.0.1", 0)) as exporter:
        url = exporter.address
        with urllib.request.urlopen(url, timeout=10) as answer:
            text = answer.read().decode()
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_every_number_of_the_status_is_exported() -> None:
    metrics = scraped(FULL)
    assert metrics["udrl_up", ()] == 1
    assert metrics["udrl_env_steps_total", ()] == 12345
    assert metrics["udrl_env_steps_per_second", ()] == 9876.5
    assert metrics["udrl_weights_lag_seconds", ()] == 0.25
    assert metrics["udrl_loss_nats", ()] == 0.5
    assert metrics["udrl_exact", ()] == 1
    assert metrics["udrl_state", (("state", "running"),)] == 1
    assert metrics["udrl_state", (("state", "ended"),)] == 0
    assert metrics["udrl_eval_return", (("stat", "mean"),)] == 42
    assert metrics["udrl_replay_return", (("stat", "max"),)] == 3
    assert metrics["udrl_commands", (("state", "issued"),)] == 1
    actor = (("actor", "actor-1"), ("host", "here"))
    assert metrics["udrl_actor_env_steps_per_second", actor] == 500.5
    assert metrics["udrl_actor_reruns_total", actor] == 2
    assert metrics["udrl_actor_failures_total", actor] == 1
    assert metrics["udrl_waiting_seconds", (("for", "actors"), ("who", "learner l"))] == 2.5
    assert metrics["udrl_quarantined_actors", ()] == 1


def test_unknown_values_are_not_exported() -> None:
    metrics = scraped(
        msgspec.structs.replace(STATUS, loss=None, time_left_s=None, evaluation=None, waiting=())
    )
    names = {name for name, _ in metrics}
    assert not names & {"udrl_loss_nats", "udrl_time_left_seconds", "udrl_eval_return"}
    assert scraped(None) == {("udrl_up", ()): 0}


def test_dashboard_queries_existing_metrics() -> None:
    metrics = {name for name, _ in scraped(FULL)}
    dashboard: dict[str, Any] = json.loads((ROOT / "deploy" / "grafana.json").read_text())
    queries = [
        target["expr"] for panel in dashboard["panels"] for target in panel.get("targets", [])
    ]
    assert len(queries) > 10
    for expression in queries:
        found = re.findall(r"udrl_\w+", expression)
        assert found, expression
        assert set(found) <= metrics, expression


def test_every_metric_is_in_the_glossary() -> None:
    page = (ROOT / "docs" / "metrics.md").read_text()
    named = set(re.findall(r"`(udrl_\w+)`", page))
    assert {name for name, _ in scraped(FULL)} == named


def test_port_in_use_is_reported() -> None:
    with (
        closing(Exporter(lambda: None, "127.0.0.1", 0)) as first,
        pytest.raises(ConfigError, match=f"port {first.port}: .*a free port"),
    ):
        Exporter(lambda: None, "127.0.0.1", first.port)


def test_address_of_the_metrics_is_a_url() -> None:
    try:
        exporter = Exporter(lambda: None, "::1", 0)
    except ConfigError:
        pytest.skip("this machine has no IPv6")
    with closing(exporter), urllib.request.urlopen(exporter.address, timeout=10) as answer:
        assert answer.status == 200


def test_invalid_host_is_reported() -> None:
    for host in ("a..b", 64 * "a", "nowhere.invalid"):
        with pytest.raises(ConfigError, match=f"metrics on {host}, port 0: .*an address of this"):
            Exporter(lambda: None, host, 0)


def test_outdated_status_is_not_exported_as_current() -> None:
    now = [0.0]
    watchers = Watchers(clock=lambda: now[0])
    assert watchers.latest() is None
    watchers.show(STATUS)
    assert watchers.latest() == STATUS
    now[0] += 60
    assert watchers.latest() is None
