"""Observation and action spaces: which elements they accept, and how they are encoded."""

from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from udrl.actions import ActionSpace, Categorical, Product, choose
from udrl.environments.action_conversions import action_conversion
from udrl.environments.observation_conversions import observation_conversion
from udrl.setting_groups import ActionSettings
from udrl.spaces import (
    Bits,
    Categories,
    Category,
    Image,
    Leaf,
    ObservationSpace,
    Record,
    Space,
    Vector,
    leaves_of,
    noise,
    parts_of,
)
from udrl.streams import Purpose, Stream, stream_key

OBSERVATIONS: list[ObservationSpace] = [
    Vector(size=3),
    Bits(size=5),
    Image(channels=2, height=4, width=5),
    Category(n=7),
    Categories(ns=(2, 5)),
]
RECORD = Record(
    (
        Leaf(("bag", 0), Vector(size=3)),
        Leaf(("bag", 1, "deep"), Bits(size=5)),
        Leaf(("here",), Category(n=7)),
        Leaf(("map",), Image(channels=1, height=4, width=5)),
    )
)
ACTIONS: list[ActionSpace] = [
    Categorical(n=2),
    Categorical(n=256),
    Categorical(n=257),
    Product(ns=(2, 256)),
    Product(ns=(2, 257)),
]
SPACES: list[Space] = [*OBSERVATIONS, *ACTIONS]


def elements(space: Space, n: int) -> Any:
    made = space.gymnasium
    made.seed(1)
    return np.array([made.sample() for _ in range(n)]).astype(space.dtype)


@pytest.mark.parametrize("space", SPACES, ids=str)
def test_elements_have_the_declared_shape_and_dtype(space: Space) -> None:
    values = elements(space, 6)
    assert values.shape == (6, *space.shape)
    assert space.fault(values, 6) is None
    assert space.n_bytes == values.nbytes // 6


@pytest.mark.parametrize("space", SPACES, ids=str)
def test_other_shapes_and_dtypes_are_rejected(space: Space) -> None:
    values = elements(space, 6)
    for other in (values[..., None], values.astype(np.float64)):
        found = space.fault(other, 6)
        assert found is not None
        assert found.endswith(f"expected {space.dtype} {(6, *space.shape)}")
    assert space.fault(values, 5) is not None


@pytest.mark.parametrize("space", [Category(n=7), Categorical(n=7)], ids=str)
def test_index_out_of_range_is_rejected(space: Space) -> None:
    assert space.fault(np.array([0, 7], space.dtype), 2) == "from 0 to 7, expected 0 to 6"


@pytest.mark.parametrize("space", [Categories(ns=(9, 3)), Product(ns=(9, 3))], ids=str)
def test_index_out_of_range_is_rejected_with_its_component(space: Space) -> None:
    found = space.fault(np.array([[8, 2], [0, 3]], space.dtype), 2)
    assert found == "from 2 to 3, expected 0 to 2 in component 1"


def test_bits_are_0_or_1() -> None:
    assert Bits(size=2).fault(np.array([[1, 2]], np.uint8), 1) == "not all 0 or 1"


def test_elements_of_a_record_are_structures_without_padding() -> None:
    values = np.zeros(3, RECORD.dtype)
    assert RECORD.fault(values, 3) is None
    assert RECORD.n_bytes == values.nbytes // 3 == sum(leaf.space.n_bytes for leaf in RECORD.leaves)
    assert [leaf.name for leaf in RECORD.leaves] == [
        "['bag'][0]", "['bag'][1]['deep']", "['here']", "['map']",
    ]  # fmt: skip
    assert [part.shape for part in parts_of(values)] == [(3, 3), (3, 5), (3,), (3, 1, 4, 5)]
    assert leaves_of(Vector(size=2)) == (Leaf((), Vector(size=2)),)


@pytest.mark.parametrize(
    ("leaf", "value", "message"),
    [
        ("['bag'][0]", np.nan, "not all finite numbers in ['bag'][0]"),
        ("['bag'][1]['deep']", 2, "not all 0 or 1 in ['bag'][1]['deep']"),
        ("['here']", 7, "from 0 to 7, expected 0 to 6 in ['here']"),
    ],
)
def test_fault_in_a_record_names_the_leaf(leaf: str, value: Any, message: str) -> None:
    values = np.zeros(3, RECORD.dtype)
    values[leaf][1] = value
    assert RECORD.fault(values, 3) == message
    assert "expected" in str(RECORD.fault(values["['bag'][0]"], 3))


def test_leaf_names_are_unique() -> None:
    twice = [msgspec.to_builtins(Leaf(("a",), Bits(size=1)))] * 2
    with pytest.raises(msgspec.ValidationError, match="two leaves have the same name"):
        msgspec.convert({"kind": "record", "leaves": twice}, ObservationSpace)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_vectors_are_finite(value: float) -> None:
    assert Vector(size=1).fault(np.array([[value]], np.float32), 1) == "not all finite numbers"


INTEGER_KEYS = Record(leaves=(Leaf((0,), Bits(size=2)), Leaf((3,), Vector(size=1))))


@pytest.mark.parametrize("space", [*OBSERVATIONS, RECORD, INTEGER_KEYS], ids=str)
def test_observation_space_round_trips_through_message_and_gymnasium(
    space: ObservationSpace,
) -> None:
    encoded = msgspec.msgpack.encode(space)
    assert msgspec.msgpack.decode(encoded, type=ObservationSpace) == space
    assert observation_conversion(space.gymnasium).plain == space


@pytest.mark.parametrize("space", ACTIONS, ids=str)
def test_action_space_round_trips_through_message_and_gymnasium(space: ActionSpace) -> None:
    encoded = msgspec.msgpack.encode(space)
    assert msgspec.msgpack.decode(encoded, type=ActionSpace) == space
    assert action_conversion(space.gymnasium, ActionSettings()).plain == space


@pytest.mark.parametrize("dtype", [np.float32, np.uint8, np.int32])
def test_noise_is_within_the_space(dtype: Any) -> None:
    made = noise(Stream(stream_key(1, Purpose.PROBE)), np.dtype(dtype), (500, 3))
    assert (made.shape, made.dtype) == ((500, 3), dtype)
    bounds = {np.float32: (-2.0, 2.0), np.uint8: (0, 255), np.int32: (0, 0)}[dtype]
    assert bounds[0] <= made.min() <= made.max() <= bounds[1]
    assert dtype == np.int32 or len(np.unique(made)) > 100


units = st.floats(0, 1, exclude_max=True)
floats = st.floats(-50, 50)


@given(st.lists(st.lists(floats, min_size=3, max_size=3), min_size=1, max_size=5), st.data())
def test_actions_are_sampled_by_inverse_cdf(rows: list[list[float]], data: st.DataObject) -> None:
    space = Categorical(n=3)
    n = len(rows)
    u = data.draw(st.lists(units, min_size=n, max_size=n))
    temperature = data.draw(st.lists(st.floats(0.1, 10), min_size=n, max_size=n))
    logits, divisors = np.array(rows), np.array(temperature)[:, None]
    chosen = space.sample(logits, divisors, np.array(u))
    for k in range(n):
        cumulative = np.cumsum(np.exp((logits[k] - logits[k].max()) / temperature[k]))
        expected = next(a for a in range(3) if u[k] * cumulative[-1] < cumulative[a])
        alone = choose(space, logits[k : k + 1], temperature[k], np.array(u[k : k + 1]))
        assert chosen[k] == expected == alone[0]
    assert space.mode(logits).tolist() == [row.index(max(row)) for row in rows]


@given(st.integers(1, 300), st.lists(units, min_size=1, max_size=20))
def test_actions_are_uniform_without_logits(n: int, u: list[float]) -> None:
    space, numbers = Categorical(n=n), np.array(u)
    flat = np.zeros((len(u), n)), np.ones((len(u), 1))
    assert space.uniform(numbers).tolist() == [int(x * n) for x in u]
    assert space.sample(*flat, numbers).tolist() == space.uniform(numbers).tolist()


def test_record_lists_its_leaves_as_python_expressions() -> None:
    leaves = (Leaf(("map", 1), Vector(size=2)), Leaf(("time",), Category(n=3)))
    assert str(Record(leaves)) == "['map'][1]: Vector(size=2), ['time']: Category(n=3)"
