"""Key expressions of verbs, publications and presence tokens."""

import re

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from udrl_proto import PROTOCOL, key_expressions, verbs

run_ids = st.from_regex(key_expressions.RUN_ID, fullmatch=True)
names = st.from_regex(re.compile(r"[A-Za-z0-9._-]{1,100}", re.ASCII), fullmatch=True)
ENDS = [verb.name for verb in verbs.VERBS] + [key_expressions.NEW_WEIGHTS, key_expressions.PROGRESS]
ends = st.sampled_from(ENDS)


@given(run_ids, ends)
def test_key_round_trips_through_parse(run_id: str, verb: str) -> None:
    assert key_expressions.parse(key_expressions.key(run_id, verb)) == (str(PROTOCOL), run_id, verb)


@given(run_ids, ends)
def test_key_is_valid_without_wildcards(run_id: str, verb: str) -> None:
    expression = zenoh.KeyExpr(key_expressions.key(run_id, verb))
    assert "*" not in str(expression)
    assert "$" not in str(expression)


@given(run_ids, st.sampled_from(["actor", "learner"]), names)
def test_token_matches_the_wildcard_of_its_run(run_id: str, role: str, name: str) -> None:
    token = zenoh.KeyExpr(key_expressions.alive(run_id, role, name))
    assert zenoh.KeyExpr(key_expressions.alive(run_id, "*", "*")).includes(token)
    assert not zenoh.KeyExpr(key_expressions.alive(run_id + "x", "*", "*")).intersects(token)


@given(st.integers(0, 99), run_ids, ends)
def test_every_hello_matches_hellos_of_all_protocols_and_nothing_else(
    protocol: int, run_id: str, verb: str
) -> None:
    key = zenoh.KeyExpr(f"udrl/{protocol}/{run_id}/{verb}")
    assert zenoh.KeyExpr(key_expressions.every_hello()).includes(key) == (verb == verbs.HELLO.name)


@pytest.mark.parametrize("expression", ["", "udrl", "udrl/1/run", "other/1/run/hello"])
def test_foreign_key_is_rejected(expression: str) -> None:
    with pytest.raises(ValueError, match=f"key '{expression}': expected udrl/"):
        key_expressions.parse(expression)


def test_verbs_are_distinct() -> None:
    assert len(set(ENDS)) == len(ENDS)
