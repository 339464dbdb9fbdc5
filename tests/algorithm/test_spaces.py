"""Observations and actions: what is of a space, and what is made of numbers."""

from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from udrl.actions import Categorical
from udrl.spaces import (
    Category,
    Image,
    ObservationSpace,
    Space,
    Vector,
    noise,
    observation_space,
)
from udrl.streams import Purpose, Stream, stream_key

SPACES: list[Space] = [
    Vector(size=3),
    Image(channels=2, height=4, width=5),
    Category(n=7),
    Categorical(n=2),
    Categorical(n=256),
    Categorical(n=257),
]


def elements(space: Space, n: int) -> Any:
    made = space.gymnasium
    made.seed(1)
    return np.array([made.sample() for _ in range(n)]).astype(space.dtype)


@pytest.mark.parametrize("space", SPACES, ids=str)
def test_elements_have_the_shape_and_dtype_that_are_said(space: Space) -> None:
    values = elements(space, 6)
    assert values.shape == (6, *space.shape)
    assert space.fault(values, 6) is None
    assert space.n_bytes == values.nbytes // 6


@pytest.mark.parametrize("space", SPACES, ids=str)
def test_other_shapes_and_dtypes_are_not_of_the_space(space: Space) -> None:
    values = elements(space, 6)
    for other in (values[..., None], values.astype(np.float64)):
        found = space.fault(other, 6)
        assert found is not None
        assert found.endswith(f"expected {space.dtype} {(6, *space.shape)}")
    assert space.fault(values, 5) is not None


@pytest.mark.parametrize("space", [Category(n=7), Categorical(n=7)], ids=str)
def test_indices_outside_are_named(space: Space) -> None:
    assert space.fault(np.array([0, 7], space.dtype), 2) == "from 0 to 7, expected 0 to 6"


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_vectors_are_finite(value: float) -> None:
    assert Vector(size=1).fault(np.array([[value]], np.float32), 1) == "not all finite numbers"


@pytest.mark.parametrize(
    "space", [Vector(size=3), Image(channels=2, height=4, width=5), Category(n=7)], ids=str
)
def test_kinds_survive_the_wire_and_gymnasium(space: ObservationSpace) -> None:
    encoded = msgspec.msgpack.encode(space)
    assert msgspec.msgpack.decode(encoded, type=ObservationSpace) == space
    assert observation_space(space.gymnasium) == space


@pytest.mark.parametrize("dtype", [np.float32, np.uint8, np.int32])
def test_noise_is_of_every_space_of_the_dtype(dtype: Any) -> None:
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
        assert chosen[k] == expected == space.choose(logits[k], temperature[k], u[k])
    assert space.mode(logits).tolist() == [row.index(max(row)) for row in rows]


@given(st.integers(1, 300), st.lists(units, min_size=1, max_size=20))
def test_without_logits_all_actions_are_as_likely(n: int, u: list[float]) -> None:
    space, numbers = Categorical(n=n), np.array(u)
    flat = np.zeros((len(u), n)), np.ones((len(u), 1))
    assert space.uniform(numbers).tolist() == [int(x * n) for x in u]
    assert space.sample(*flat, numbers).tolist() == space.uniform(numbers).tolist()
