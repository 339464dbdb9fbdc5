"""Encoding and decoding of messages, and the cost of rejecting invalid ones."""

import time
import tracemalloc
from collections.abc import Callable
from typing import Any

import msgpack
import msgspec
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tests.proto.strategies import MESSAGES, messages
from udrl.config import Config
from udrl.digests import episode_digest
from udrl.episode import Episode
from udrl.errors import InvalidMessage
from udrl.spaces import Vector
from udrl_proto.codec import (
    LARGEST,
    SMALL,
    decode,
    decode_array,
    decode_episode,
    encode,
    encode_array,
    encode_episode,
)
from udrl_proto.messages import (
    ArrayMessage,
    CommandsRequest,
    EpisodeMessage,
    Hello,
    HelloRequest,
    Message,
    Problem,
    VersionMessage,
    Wait,
    WeightsMessage,
    WeightsRequest,
)

kinds = pytest.mark.parametrize("kind", MESSAGES, ids=lambda kind: kind.__name__)
any_kind = st.sampled_from(MESSAGES)
any_message = any_kind.flatmap(messages)
#: Any MessagePack value, including types that no message has.
plain = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text()
    | st.binary() | st.builds(msgpack.ExtType, st.integers(0, 127), st.binary()),
    lambda inner: st.lists(inner) | st.dictionaries(st.text() | st.binary(), inner),
)  # fmt: skip


def assert_message_or_invalid(data: bytes, kind: type[Message]) -> None:
    """Assert that data decodes to a message that encodes to itself, or raises InvalidMessage."""
    try:
        message = decode(data, kind)
    except InvalidMessage:
        return
    assert encode(decode(encode(message), kind)) == encode(message)


@kinds
@given(st.data())
def test_message_round_trips(kind: type[Message], data: st.DataObject) -> None:
    message = data.draw(messages(kind))
    assert decode(encode(message), kind) == message


@given(st.binary(max_size=200), any_kind)
def test_arbitrary_bytes_are_rejected(data: bytes, kind: type[Message]) -> None:
    assert_message_or_invalid(data, kind)


@given(plain, any_kind)
def test_arbitrary_values_are_rejected(value: Any, kind: type[Message]) -> None:
    assert_message_or_invalid(msgpack.packb(value), kind)


@given(any_message, st.data())
def test_truncated_message_is_rejected(message: Message, data: st.DataObject) -> None:
    encoded = encode(message)
    length = data.draw(st.integers(0, len(encoded) - 1))
    with pytest.raises(InvalidMessage):
        decode(encoded[:length], type(message))


@given(any_message, st.data())
def test_changed_message_decodes_to_another_one_or_is_rejected(
    message: Message, data: st.DataObject
) -> None:
    encoded = bytearray(encode(message))
    where = data.draw(st.integers(0, len(encoded) - 1))
    encoded[where] = data.draw(st.integers(0, 255))
    assert_message_or_invalid(bytes(encoded), type(message))


@given(any_message, st.data())
def test_message_with_a_changed_value_decodes_to_another_one_or_is_rejected(
    message: Message, data: st.DataObject
) -> None:
    fields = msgpack.unpackb(encode(message)) or {"none": 0}
    fields[data.draw(st.sampled_from(sorted(fields)))] = data.draw(plain)
    assert_message_or_invalid(msgpack.packb(fields), type(message))


@given(any_message, any_kind)
def test_message_of_another_type_decodes_to_another_one_or_is_rejected(
    message: Message, kind: type[Message]
) -> None:
    assert_message_or_invalid(encode(message), kind)


def packed(**fields: Any) -> bytes:
    data: bytes = msgpack.packb(fields)
    return data


@pytest.mark.parametrize(
    ("data", "kind", "complaint"),
    [
        (b"", HelloRequest, "incomplete input"),
        (b"\xc1", HelloRequest, "not MessagePack"),
        (b"\x80\x80", HelloRequest, "extra data"),
        (b"\x90", HelloRequest, "Expected `object`"),
        (packed(surplus=1), HelloRequest, "unknown field `surplus`"),
        (packed(version=1), WeightsMessage, "missing required field `weights`"),
        (packed(version="newest"), WeightsRequest, "newest"),
        (packed(version=1.0), WeightsRequest, "`$.version`"),
        (packed(version=True), WeightsRequest, "`$.version`"),
        (packed(version=-1), WeightsRequest, ">= 0"),
        (packed(version=2**63), WeightsRequest, "<= 4611686018427387904"),
        (packed(version=1, weights="AAAA"), WeightsMessage, "Expected `bytes`"),
        (packed(code="a/b", message=""), Problem, "`$.code`"),
        (packed(code="*", message=""), Problem, "`$.code`"),
        (packed(code="a\n", message=""), Problem, "`$.code`"),
        (packed(code="", message=""), Problem, "`$.code`"),
        (packed(code="a", message="x" * 4001), Problem, "<= 4000"),
        (packed(on="", retry_after_s=0), Wait, "> 0"),
        (packed(on="", retry_after_s=float("nan")), Wait, "> 0"),
        (packed(on="", retry_after_s=float("inf")), Wait, "<= 3600"),
        (packed(actor="a", wanted=1, spare_cores=float("nan")), CommandsRequest, "`$.spare_cores`"),
        (packed(actor="a", wanted=1, running=[0] * 65_537), CommandsRequest, "<= 65536"),
        (packed(actor="a", wanted=1, running=[-1]), CommandsRequest, "`$.running[0]`"),
        (b"\x81\x01\x02", HelloRequest, "not MessagePack"),  # a key that is a number
        (b"\x81\xc4\x07version\x02", WeightsRequest, "Expected `str`"),  # a key that is bytes
        (b"\x82\xa7version\x02\xa7version\x03", WeightsRequest, "duplicate key"),
        (b"\x81\xa7version\xa1\xff", WeightsRequest, "not MessagePack"),  # not UTF-8
        (b"\x81\xa7version\xd4\x01\x00", WeightsRequest, "max_ext_len"),
        (b"\x81\xa7version\xc7\x00\x01", WeightsRequest, "`$.version`"),  # an empty extension
        (b"\x81\xa7version\xd6\xff\x00\x00\x00\x00", WeightsRequest, "max_ext_len"),  # a timestamp
    ],
)
def test_error_describes_the_fault(data: bytes, kind: type[Message], complaint: str) -> None:
    with pytest.raises(InvalidMessage, match=rf"^{kind.__name__}: ") as caught:
        decode(data, kind)
    assert complaint in str(caught.value)


@pytest.mark.parametrize(
    ("setting", "complaint"),
    [
        ({}, None),
        ({"last_few": 501}, "at most replay_size"),
        ({"max_return": float("nan")}, "finite"),
        ({"batch_size": 0}, "batch_size = 0: expected an integer >= 1"),
        ({"bach_size": 512}, "did you mean 'batch_size'"),
        ({"training": {"batch_size": 512}}, "unknown setting 'training'"),
        ({"hidden": [[8]]}, r"Expected `int \| str`, got `array`"),
    ],
)
def test_hello_with_an_invalid_configuration_is_rejected(
    setting: dict[str, Any], complaint: str | None
) -> None:
    environment = {
        "observation_space": {"kind": "vector", "size": 1},
        "action_space": {"kind": "categorical", "n": 2},
        "max_episode_steps": 3,
    }
    config = {"environment": "x", **setting}
    data = packed(
        protocol=1, software="", run_id="r", config=config, environment=environment, graph=b""
    )
    if complaint is None:
        assert decode(data, Hello).config == Config(environment="x")
        return
    with pytest.raises(InvalidMessage, match=complaint):
        decode(data, Hello)


@pytest.mark.parametrize(
    "data",
    [
        b"\xc6\xff\xff\xff\xff",  # 4 GB of bytes
        b"\xdb\xff\xff\xff\xff",  # 4 GB of text
        b"\xdd\xff\xff\xff\xff",  # an array of 4 G elements
        b"\xdd\x00\x10\x00\x00",  # an array of 1 M elements
        b"\xdf\xff\xff\xff\xff",  # a map of 4 G pairs
        b"\xc9\xff\xff\xff\xff\x01",  # 4 GB of an extension
        b"\xdc\x04\x00" * 1000,  # arrays in arrays
        b"\xde\x04\x00\xa1x" * 1000,  # maps in maps
        b"\x91" * SMALL,
        b"\x81\xa1x" * (SMALL // 3),
    ],
    ids=lambda data: data[:6].hex(),
)
def test_declared_size_allocates_nothing_in_advance(data: bytes) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(InvalidMessage):
            decode(data, HelloRequest)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 20 * SMALL


@pytest.mark.parametrize(
    "data",
    [
        b"\xdd\x00\x0f\xff\xff" * (SMALL // 5),
        b"\x80" * SMALL,
        b"\xdd\x00\x0f\xff\xf0" + b"\x00" * SMALL,
    ],
    ids=["deep", "many", "long"],
)
def test_cost_of_a_message_is_linear_in_its_size(data: bytes) -> None:
    began = time.process_time()
    with pytest.raises(InvalidMessage):
        decode(data[:SMALL], HelloRequest)
    # About 0.1 s. If each level or element cost what it declares, it would be days.
    assert time.process_time() - began < 10.0


def test_size_is_checked_before_decoding(monkeypatch: pytest.MonkeyPatch) -> None:
    def unpackb(*args: Any, **kwargs: Any) -> Any:
        pytest.fail("decoded")

    monkeypatch.setattr(msgpack, "unpackb", unpackb)
    with pytest.raises(InvalidMessage, match=r"^WeightsMessage: 11 bytes, expected at most 10$"):
        decode(bytes(11), WeightsMessage, limit=10)


def test_bytes_of_a_message_may_fill_its_limit() -> None:
    message = WeightsMessage(version=1, weights=bytes(2 * SMALL))
    data = encode(message)
    assert decode(data, WeightsMessage, len(data)) == message
    with pytest.raises(InvalidMessage, match="at most"):
        decode(data, WeightsMessage, len(data) - 1)


def test_invalid_unicode_is_replaced_when_encoded() -> None:
    problem = decode(encode(Problem(code="invalid", message="file \udcff is odd")), Problem)
    assert problem.message == "file ? is odd"


def test_loss_may_be_nan_to_report_divergence() -> None:
    message = VersionMessage(
        learner="l", version=1, weights=b"", optimizer=b"", loss=float("nan"), train_s=0.0
    )
    assert np.isnan(decode(encode(message), VersionMessage).loss)


# Arrays and episodes.

dtypes: st.SearchStrategy[np.dtype[Any]] = st.sampled_from(["<f4", "|u1", "<i4"]).map(np.dtype)
shapes = arrays.array_shapes(min_dims=0, max_dims=4, max_side=5)


@given(arrays.arrays(dtypes, shapes))
def test_array_round_trips(array: np.typing.NDArray[Any]) -> None:
    decoded = decode_array(decode(encode(encode_array(array)), ArrayMessage))
    assert decoded.dtype == array.dtype
    assert decoded.shape == array.shape
    assert decoded.tobytes() == array.tobytes()


@pytest.mark.parametrize(
    "arrange",
    [lambda a: a.astype(">f4"), lambda a: a.T.copy().T, lambda a: np.repeat(a, 2, 1)[:, ::2]],
    ids=["big-endian", "column-major", "strided"],
)
def test_array_is_encoded_little_endian_and_row_major(arrange: Callable[[Any], Any]) -> None:
    rows = np.arange(6, dtype="<f4").reshape(2, 3)
    assert encode_array(arrange(rows)) == ArrayMessage(
        dtype="<f4", shape=(2, 3), data=rows.tobytes()
    )


def test_decoded_array_is_read_only() -> None:
    assert not decode_array(encode_array(np.zeros(3, np.float32))).flags.writeable


@pytest.mark.parametrize(
    "shape", [(), (2,), (4, 1), (3, 2), (2**62,), (2**62, 4), (2**62,) * 4, (2**32, 2**32)]
)
def test_array_whose_bytes_do_not_match_its_shape_is_rejected(shape: tuple[int, ...]) -> None:
    message = decode(packed(dtype="<f4", shape=shape, data=bytes(12)), ArrayMessage)
    with pytest.raises(InvalidMessage, match="12 bytes for <f4"):
        decode_array(message)


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        ({"shape": [0]}, ">= 1"),
        ({"shape": [-1]}, ">= 1"),
        ({"shape": [2**63]}, "<= "),
        ({"shape": [0, 2**62]}, ">= 1"),
        ({"shape": [1] * 5}, "length <= 4"),
        ({"shape": 1}, "Expected `array`"),
        ({"dtype": "|O"}, "`$.dtype`"),
        ({"dtype": ">f4"}, "`$.dtype`"),
        ({"dtype": "<f8"}, "`$.dtype`"),
        ({"data": [0]}, "Expected `bytes`"),
    ],
)
def test_invalid_array_is_rejected(fields: dict[str, Any], complaint: str) -> None:
    with pytest.raises(InvalidMessage, match=r"^ArrayMessage: ") as caught:
        decode(packed(**{"dtype": "<f4", "shape": [1], "data": bytes(4), **fields}), ArrayMessage)
    assert complaint in str(caught.value)


@given(
    length=st.integers(1, 5), size=st.integers(1, 3), flags=st.tuples(st.booleans(), st.booleans())
)
@example(length=1000, size=8, flags=(True, False))
def test_episode_round_trips(length: int, size: int, flags: tuple[bool, bool]) -> None:
    numbers = np.arange(length * size, dtype=np.float32)
    episode = Episode(
        7,
        numbers.reshape(length, size),
        numbers[:length].astype(np.uint8),
        numbers[:length],
        *flags,
    )
    data = encode_episode(episode, "actor-1")
    message = decode(data, EpisodeMessage, LARGEST)
    assert message.actor == "actor-1"
    assert episode_digest(decode_episode(message, Vector(size=size))) == episode_digest(episode)


def test_every_message_type_rejects_unknown_fields() -> None:
    for kind in MESSAGES:
        assert msgspec.inspect.type_info(kind).forbid_unknown_fields  # type: ignore[attr-defined]
