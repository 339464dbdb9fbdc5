"""Conversions between an environment's spaces and the algorithm's."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from udrl.actions import Categorical, Product
from udrl.environments.action_conversions import action_conversion, default_bins
from udrl.environments.observation_conversions import observation_conversion
from udrl.errors import InvalidData, UnsupportedEnvironment
from udrl.setting_groups import ActionSettings
from udrl.spaces import Bits, Categories, Category, Image, Record, Vector, leaves_of

AnySpace = spaces.Space[Any]

shapes = st.lists(st.integers(1, 3), max_size=3).map(tuple)
discretes = st.builds(
    lambda n, start: spaces.Discrete(n, start=start), st.integers(1, 5), st.integers(-3, 3)
)
multi_discretes = st.lists(st.integers(1, 4), min_size=1, max_size=4).map(
    lambda ns: spaces.MultiDiscrete(np.array(ns), start=np.arange(len(ns)) - 1)
)


def boxes(*dtypes: Any) -> st.SearchStrategy[AnySpace]:
    return st.builds(
        lambda shape, dtype: spaces.Box(-3, 4, shape, dtype), shapes, st.sampled_from(dtypes)
    )


images = st.lists(st.integers(1, 4), min_size=2, max_size=3).map(
    lambda shape: spaces.Box(0, 255, tuple(shape), np.uint8)
)
bits = st.lists(st.integers(1, 3), min_size=1, max_size=2).map(spaces.MultiBinary)


def nested(leaves: st.SearchStrategy[Any]) -> st.SearchStrategy[AnySpace]:
    return st.recursive(
        leaves,
        lambda inner: st.one_of(
            st.lists(inner, min_size=1, max_size=3).map(spaces.Tuple),
            st.dictionaries(st.text(max_size=3), inner, min_size=1, max_size=3).map(spaces.Dict),
        ),
        max_leaves=5,
    )


# float64 is rounded to float32, so it does not round-trip.
numbers = boxes(np.float32, np.int16, np.int64)
observed = nested(st.one_of(discretes, multi_discretes, numbers, images, bits))
numbers_64 = boxes(np.float32, np.float64, np.int16, np.int64)
done = nested(st.one_of(discretes, multi_discretes, numbers_64, bits))


def elements_equal(one: Any, other: Any) -> bool:
    """Whether two elements are equal, including the types that an environment may rely on."""
    if isinstance(one, dict):
        return list(one) == list(other) and all(elements_equal(one[k], other[k]) for k in one)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(elements_equal, one, other))
    return np.asarray(one).dtype == np.asarray(other).dtype and np.array_equal(one, other)


def stacked(samples: list[Any]) -> Any:
    """Stack elements as datasets do: one array per leaf."""
    first = samples[0]
    if isinstance(first, dict):
        return {k: stacked([s[k] for s in samples]) for k in first}
    if isinstance(first, tuple):
        return tuple(stacked([s[k] for s in samples]) for k in range(len(first)))
    return np.stack([np.asarray(s) for s in samples])


@given(observed, st.integers(0, 100))
def test_observations_round_trip(space: AnySpace, seed: int) -> None:
    space.seed(seed)
    samples = [space.sample() for _ in range(3)]
    conversion = observation_conversion(space)
    plain = conversion.convert(stacked(samples), (3,))
    assert conversion.plain.fault(plain, 3) is None
    assert elements_equal(conversion.back(plain), stacked(samples))
    for k, sample in enumerate(samples):
        one = conversion.one(sample)
        assert np.array_equal(one, plain[k])
        assert elements_equal(conversion.back_one(one), sample)


@given(done, st.integers(0, 100))
def test_every_action_is_valid_and_round_trips(space: AnySpace, seed: int) -> None:
    conversion = action_conversion(space, ActionSettings())
    rng = np.random.default_rng(seed)
    plain = conversion.plain.uniform(rng.random((4, *conversion.plain.shape)))
    own = [conversion.back_one(action) for action in plain.tolist()]
    assert all(map(space.contains, own)), own
    assert elements_equal(conversion.back(plain), stacked(own))
    again = conversion.convert(stacked(own), (4,))
    assert again.dtype == conversion.plain.dtype
    # Bins of whole numbers may contain the same number twice.
    assert elements_equal(conversion.back(again), stacked(own))


def test_observation_space_conversion() -> None:
    kinds = [leaf.space for leaf in leaves_of(observation_conversion(spaces.Dict(
        a=spaces.Box(-1, 1, (2, 3)),
        b=spaces.Box(-1, 1, ()),
        c=spaces.Box(0, 255, (8, 9, 3), np.uint8),
        d=spaces.Box(0, 255, (5,), np.uint8),
        e=spaces.Discrete(4, start=2),
        f=spaces.MultiDiscrete(np.array([[2, 3], [4, 5]])),
        g=spaces.MultiBinary((2, 3)),
    )).plain)]  # fmt: skip
    assert kinds == [
        Vector(size=6), Vector(size=1), Image(channels=3, height=8, width=9), Vector(size=5),
        Category(n=4), Categories(ns=(2, 3, 4, 5)), Bits(size=6),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("space", "plain"),
    [
        (spaces.Discrete(3, start=5), Categorical(n=3)),
        (spaces.MultiDiscrete([3, 5]), Product(ns=(3, 5))),
        (spaces.MultiBinary(3), Product(ns=(2, 2, 2))),
        (spaces.Box(-1, 1, (2,)), Product(ns=(11, 11))),
        (spaces.Box(-1, 1, (3,)), Product(ns=(7, 7, 7))),
        (spaces.Box(0, 3, (2,), np.int64), Product(ns=(4, 4))),
        (spaces.Dict(a=spaces.Discrete(2), b=spaces.Box(-1, 1, (1,))), Product(ns=(2, 11))),
        (spaces.Tuple((spaces.Discrete(2),)), Product(ns=(2,))),
    ],
    ids=str,
)
def test_action_space_conversion(space: AnySpace, plain: Any) -> None:
    assert action_conversion(space, ActionSettings()).plain == plain


def test_bins_include_bounds_and_centre() -> None:
    space = spaces.Box(np.array([-2, 0], np.float32), np.array([2, 1], np.float32))
    conversion = action_conversion(space, ActionSettings(action_bins=5))
    found = [conversion.back_one([k, k]).tolist() for k in range(5)]
    assert found == [[-2, 0], [-1, 0.25], [0, 0.5], [1, 0.75], [2, 1]]
    assert all(default_bins(n) % 2 for n in range(1, 20))


@given(st.lists(st.floats(-9, 9), min_size=1, max_size=5))
def test_dataset_action_is_mapped_to_the_nearest_bin(values: list[float]) -> None:
    conversion = action_conversion(spaces.Box(-2, 2, (1,), np.float64), ActionSettings())
    (known,) = conversion._values  # type: ignore[attr-defined]
    plain = conversion.convert(np.array(values)[:, None], (len(values),))
    for value, (chosen,) in zip(values, plain.tolist(), strict=True):
        assert abs(known[chosen] - value) == min(abs(k - value) for k in known)


def test_undeclared_bounds_can_be_configured() -> None:
    space = spaces.Box(np.array([-np.inf, 0], np.float32), np.array([1, np.inf], np.float32))
    given_ = ActionSettings(action_low=-5, action_high=7, action_bins=3)
    conversion = action_conversion(space, given_)
    assert [conversion.back_one([k, k]).tolist() for k in range(3)] == [[-5, 0], [-2, 3.5], [1, 7]]


INTEGERS = spaces.Box(-np.inf, np.inf, (1,), np.int64)


@pytest.mark.parametrize(
    ("space", "bins"),
    [
        (INTEGERS, [-5, 1, 7]),
        (spaces.Box(INTEGERS.low, INTEGERS.high, dtype=np.int64), [-5, 1, 7]),
        (spaces.Box(-np.inf, np.inf, (1,), np.int8), [-5, 1, 7]),
        (spaces.Box(0, np.inf, (1,), np.int32), [0, 4, 7]),
        (spaces.Box(-np.inf, 3, (1,), np.int32), [-5, -1, 3]),
        (spaces.Box(0, 2**64 - 1, (1,), np.uint64), [0, 4, 7]),
        (spaces.Box(-128, 127, (1,), np.int8), [-128, 0, 127]),
        (spaces.Box(0, 255, (1,), np.uint8), [0, 128, 255]),
    ],
    ids=["int64", "copied bounds", "int8", "no higher", "no lower", "uint64", "all int8", "bytes"],
)
def test_undeclared_bounds_of_integers_can_be_configured(space: AnySpace, bins: list[int]) -> None:
    """Gymnasium replaces infinite bounds of integers by the limits of their dtype."""
    given_ = ActionSettings(action_low=-5, action_high=7, action_bins=3)
    conversion = action_conversion(space, given_)
    assert [conversion.back_one([k]).tolist() for k in range(3)] == [[b] for b in bins]


@pytest.mark.parametrize(("low", "high"), [(-1000, 7), (-5, 128), (-5, 127.5)])
def test_configured_bounds_must_fit_the_dtype(low: float, high: float) -> None:
    space = spaces.Box(-np.inf, np.inf, (1,), np.int8)
    with pytest.raises(
        UnsupportedEnvironment, match=rf"its action\[0\] is from {low} to {high}.*int8.*-128 to 127"
    ):
        action_conversion(space, ActionSettings(action_low=low, action_high=high))


DICT = spaces.Dict(
    inventory=spaces.Tuple((spaces.Discrete(3), spaces.Box(-1, 1, (2,)), spaces.MultiBinary(2))),
    map=spaces.Box(0, 255, (4, 4), np.uint8),
)


def valid_element() -> Any:
    return {
        "inventory": (1, np.zeros(2, np.float32), np.zeros(2, np.int8)),
        "map": np.zeros((4, 4), np.uint8),
    }


def corrupt(where: Callable[[Any], Any]) -> Any:
    value = valid_element()
    return where(value)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (corrupt(lambda v: v | {"map": np.zeros((4, 5), np.uint8)}),
         r"observation\['map'\]: an array of uint8, shape \(4, 5\), expected an element of Box"),
        (corrupt(lambda v: v | {"inventory": (3, *v["inventory"][1:])}),
         r"observation\['inventory'\]\[0\]: 3 \(int.*\), expected an element of Discrete\(3\)"),
        (corrupt(lambda v: v | {"inventory": v["inventory"][:2]}),
         r"a dict of 'inventory', 'map', without observation\['inventory'\]\[2\]"),
        (corrupt(lambda v: {"map": v["map"]}), r"without observation\['inventory'\]\[0\]"),
        (np.zeros(3, np.float32), r"an array of float32, shape \(3,\), without observation"),
        (None, r"None \(NoneType\), without observation\['inventory'\]\[0\]"),
    ],
)  # fmt: skip
def test_invalid_observation_is_rejected_with_its_leaf(value: Any, message: str) -> None:
    with pytest.raises(InvalidData, match=message):
        observation_conversion(DICT).one(value)


def test_action_component_out_of_range_is_rejected() -> None:
    conversion = observation_conversion(spaces.MultiDiscrete([2, 3]))
    with pytest.raises(
        InvalidData, match=r"observation: \[1, 3\], expected an element of MultiDiscrete"
    ):
        conversion.one(np.array([1, 3]))
    with pytest.raises(InvalidData, match="expected an element of MultiDiscrete"):
        conversion.one(np.array([0.5, 1.0]))


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (spaces.Text(4), "its observation is Text.*Box, Discrete.*vary.*TransformObservation"),
        (
            spaces.Dict(
                a=spaces.Discrete(2),
                b=spaces.Tuple((spaces.Text(4), spaces.Sequence(spaces.Discrete(2)))),
            ),
            r"its observation\['b'\]\[0\] is Text.*also.*\['b'\]\[1\] is Sequence",
        ),
        (
            spaces.Dict(say=spaces.Text(4), see=spaces.Discrete(2)),
            r"observation\['say'\] is Text.*leave it out with gymnasium.wrappers.FilterObs",
        ),
        (spaces.Box(-1, 1, (0, 3)), "supported are Box"),
        (spaces.Discrete(2**20 + 1), "1,048,577 states.*at most 1,048,576"),
        (spaces.MultiDiscrete([2**20, 2]), "1,048,578 values in all.*at most 1,048,576"),
        (spaces.Dict({}), "0 parts; supported are 1 to 256"),
        (spaces.Box(-1, 1, (600, 600, 3)), "has 1,080,000 numbers, at most 1,048,576.*as uint8"),
        (spaces.MultiBinary(2**20 + 1), "has 1,048,577 numbers, at most 1,048,576"),
        (
            spaces.Dict([(7, spaces.Discrete(2)), (1000, spaces.Discrete(2))]),  # type: ignore[list-item]
            r"observation\[1000\] has the key 1000 .*expected a string.*from 0 to 256; rename",
        ),
        (spaces.Dict({"k" * 201: spaces.Discrete(2)}), "has the key 'k.*at most 200 characters"),
    ],
    ids=str,
)
def test_unsupported_observation_space_is_rejected_by_name(space: AnySpace, message: str) -> None:
    with pytest.raises(UnsupportedEnvironment, match=message):
        observation_conversion(space)


@pytest.mark.parametrize(
    ("space", "message", "bins"),
    [
        (spaces.Text(4), "its action is Text.*Discrete, MultiDiscrete.*TransformAction", None),
        (
            spaces.Box(-np.inf, np.inf, (2,)),
            r"its action\[0\] has no bounds.*--set action_low=-1 --set action_high=1",
            None,
        ),
        (
            spaces.Box(-np.finfo(np.float64).max, np.finfo(np.float64).max, (2,), np.float64),
            r"its action\[0\] has no bounds",
            None,
        ),
        (spaces.Box(-np.inf, 5, (2,), np.int64), r"its action\[0\] has no bounds", None),
        (
            spaces.Dict(a=spaces.Box(1, 1, (2,))),
            r"its action\['a'\]\[0\] is from 1 to 1; expected",
            None,
        ),
        (spaces.Dict({}), "has no parts", None),
        (spaces.Box(-1, 1, (99,)), "99,000 outputs, at most 65,536.*lower action_bins", 1000),
    ],
    ids=str,
)
def test_unsupported_action_space_is_rejected_by_name(
    space: AnySpace, message: str, bins: int | None
) -> None:
    with pytest.raises(UnsupportedEnvironment, match=message):
        action_conversion(space, ActionSettings(action_bins=bins))


def test_record_has_the_converted_leaves() -> None:
    plain = observation_conversion(DICT).plain
    assert isinstance(plain, Record)
    assert [leaf.name for leaf in plain.leaves] == [
        "['inventory'][0]", "['inventory'][1]", "['inventory'][2]", "['map']",
    ]  # fmt: skip
