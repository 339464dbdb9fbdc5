"""Text of peers is escaped before it is logged."""

import json
import os
import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.proto.scripted import Scripted
from udrl.errors import InvalidMessage, Refused
from udrl_proto import verbs
from udrl_proto.codec import decode, encode
from udrl_proto.messages import Acknowledged, FailureMessage, Problem, StateRequest
from udrl_proto.replay_client import ReplayClient
from udrl_proto.text import as_json, printable

HOSTILE = (
    "no\n2026-01-01 00:00:00,000 ERROR   forged\r\x1b[2J\x1b]0;title\x07\x9b31m\u202e\u2028\x00"
)


@pytest.mark.parametrize(
    ("raw", "shown"),
    [
        ("", ""),
        ("läuft ± 3.5 観測 🙂", "läuft ± 3.5 観測 🙂"),
        ("a\nb", r"a\nb"),
        ("\x1b[31mred\x1b[0m", r"\x1b[31mred\x1b[0m"),
        ("\x07\x00\x7f\x9b", r"\x07\x00\x7f\x9b"),
        ("\u202e\u2028\ud800", r"\u202e\u2028\ud800"),
        ("\U000e0001", r"\U000e0001"),
        (ValueError("two\nlines"), r"two\nlines"),
    ],
)
def test_control_sequences_are_escaped(raw: object, shown: str) -> None:
    assert printable(raw) == shown


@given(st.text())
def test_no_control_character_remains(text: str) -> None:
    shown = printable(text)
    assert all(unicodedata.category(c)[0] != "C" for c in shown)
    assert "\n" not in shown
    assert printable(shown) == shown


def test_name_of_an_unknown_field_is_escaped() -> None:
    data = encode(Acknowledged()).replace(b"\x80", b"\x81\xa6\x1b[2J\n!\x01")
    with pytest.raises(InvalidMessage) as no:
        decode(data, FailureMessage)
    assert str(no.value).isprintable()
    assert r"\x1b[2J" in str(no.value)


def test_refusal_is_escaped() -> None:
    scripted = Scripted("run")
    scripted.answers(verbs.STATE, lambda _: Problem(code="rewind", message=HOSTILE))
    with pytest.raises(Refused, match=r"no\\n2026") as no:
        ReplayClient(scripted.transport, "run", "learner l").request(
            verbs.STATE, StateRequest(learner="l")
        )
    assert str(no.value).isprintable()


@given(st.binary())
def test_file_names_that_are_not_utf8_survive_json(name: bytes) -> None:
    path = os.fsdecode(name)
    found = json.loads(as_json({"run_dir": path, "seeds": (1, 2.5)}))
    assert found == {"run_dir": path, "seeds": [1, 2.5]}
