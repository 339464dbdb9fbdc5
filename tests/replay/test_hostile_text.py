"""Peers cannot forge log lines or control the terminal with the text that they send."""

import logging
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from msgspec.structs import replace

from tests.proto.test_text import HOSTILE
from tests.replay.synthetic import create, join
from udrl.config import Budget
from udrl.errors import Refused
from udrl_proto import key_expressions, verbs
from udrl_proto.codec import encode
from udrl_proto.memory_transport import Exchange, MemoryTransport
from udrl_proto.messages import CommandsRequest, FailureMessage
from udrl_proto.replay_client import ReplayClient
from udrl_proto.reports import Status, StatusRequest
from udrl_replay.replay_service import ReplayService

RUN = "synthetic"


@pytest.fixture
def transport(tmp_path: Path) -> Iterator[MemoryTransport]:
    """Connects to a replay service that is running."""
    with ExitStack() as stack:
        store = stack.enter_context(closing(create(tmp_path)))
        transport, stop = MemoryTransport(Exchange()), threading.Event()
        service = ReplayService(transport, store, Budget(max_env_steps=1000), tmp_path)
        stack.callback(service.close)
        serving = threading.Thread(target=service.serve, args=[stop])
        serving.start()
        stack.callback(serving.join)
        stack.callback(stop.set)
        yield transport


def send_hostile_text(transport: MemoryTransport) -> Status:
    """Send hostile text in every field that has text; return the status of the run."""
    client = ReplayClient(transport, RUN, "the test", patience_s=10.0)
    unknown = encode(CommandsRequest(actor="a", wanted=1)).replace(b"wanted", b"\n\x1b[2Jw")
    for _ in range(2):
        with pytest.raises(Refused, match="unknown field"):
            client.request(verbs.COMMANDS, unknown)
    hostile = replace(join("a"), host=HOSTILE, software=HOSTILE, numerics_class=HOSTILE)
    client.request(verbs.JOIN, hostile)
    transport.declare_presence(key_expressions.alive(RUN, "actor", HOSTILE)).undeclare()
    spec = hostile.environment
    assert spec is not None
    with pytest.raises(Refused, match="the run's environment is"):
        client.request(verbs.JOIN, replace(hostile, environment=replace(spec, max_episode_steps=3)))
    for _ in range(3):
        (command,) = client.request(verbs.COMMANDS, CommandsRequest(actor="a", wanted=1)).commands
        failure = FailureMessage(actor="a", command_id=command.id, error=HOSTILE)
        client.request(verbs.FAILURE, failure)
    return client.request(verbs.STATUS, StatusRequest())


def test_hostile_text_forges_no_log_line(
    transport: MemoryTransport, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, "udrl"):
        status = send_hostile_text(transport)
    logged = [record.getMessage() for record in caplog.records]
    for part in ("joined from no", ", process ", " connected", " disconnected",
                 "invalid commands: ", "refused join: ", "failed on command",
                 "failed 3 times"):  # fmt: skip
        assert any(part in line for line in logged), part
    assert [line for line in logged if not line.isprintable()] == []
    assert status.state == "failed"
    assert status.problem.isprintable()
