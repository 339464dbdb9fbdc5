"""A small run of the fuzzer: mutated requests to every queryable.

``python -m tests.fuzz`` does more of the same, guided by coverage.
"""

import logging
import random
from collections.abc import Iterator

import pytest
from msgspec.structs import replace

import udrl_replay.admission
from tests.fuzz.world import NAMES, Target, World, valid_requests
from udrl_proto import verbs
from udrl_proto.codec import decode, encode
from udrl_proto.messages import JoinRequest, Problem

INPUTS = 10_000

#: Boundary values.
_EDGES = (b"\x00", b"\x7f", b"\x80", b"\xff", b"\xc0", b"\xc1", b"\xca\x7f\xc0\x00\x00",
          b"\xcb\x7f\xf0\x00\x00\x00\x00\x00\x00", b"\xcf\xff\xff\xff\xff\xff\xff\xff\xff",
          b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff")  # fmt: skip


def mutated(seed: bytes, other: bytes, draw: random.Random) -> bytes:
    """Return a seed with a few mutations."""
    data = bytearray(seed)
    for _ in range(draw.choice((0, 1, 1, 2, 4))):
        at = draw.randrange(len(data) + 1)
        match draw.randrange(5):
            case 0 if at < len(data):
                data[at] = draw.randrange(256)
            case 1:
                data[at:at] = draw.choice(_EDGES)
            case 2:
                del data[at : at + draw.randrange(1, 9)]
            case 3:
                data[at : at + len(_EDGES[0])] = draw.choice(_EDGES)
            case 4:
                cut = draw.randrange(len(other) + 1)
                data[at:] = other[cut:]
    return bytes(data)


@pytest.fixture(autouse=True)
def quiet(caplog: pytest.LogCaptureFixture) -> None:
    """Do not record thousands of refusals."""
    caplog.set_level(logging.CRITICAL, "udrl")


@pytest.fixture(scope="module")
def requests() -> list[tuple[str, bytes]]:
    return valid_requests()


@pytest.fixture
def target(requests: list[tuple[str, bytes]]) -> Iterator[Target]:
    target = Target(requests)
    yield target
    target.close()


def test_valid_requests_reach_every_verb_and_are_accepted(
    requests: list[tuple[str, bytes]],
) -> None:
    assert {verb for verb, _ in requests} == set(NAMES)
    world = World()
    for verb, data in requests:
        answer = world.send_raw(verb, data)
        assert not isinstance(answer, Problem), f"{verb}: {answer}"
    assert world.service.run.progress.iteration >= 2
    world.close()


def test_number_of_actors_is_bounded(
    requests: list[tuple[str, bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(udrl_replay.admission, "MOST_ACTORS", 2)
    join = decode(next(data for verb, data in requests if verb == verbs.JOIN.name), JoinRequest)
    world = World()
    codes = [
        getattr(world.send_raw(verbs.JOIN.name, encode(replace(join, id=name))), "code", None)
        for name in ("a", "b", "c")
    ]
    world.close()
    assert codes == [None, None, "too_many_actors"]


def test_every_input_is_answered_and_breaks_no_invariant(target: Target) -> None:
    draw = random.Random(7)
    seeds = target.seeds()
    for _ in range(INPUTS):
        target(mutated(draw.choice(seeds), draw.choice(seeds), draw))
    assert target.refused > INPUTS / 10
    assert target.accepted > INPUTS / 10
