from itertools import pairwise

import numpy as np
import pytest

from udrl.streams import Purpose, Stream, stream_key


def philox4x64(key: int, counter: int) -> list[int]:
    """Philox4x64-10 as Salmon et al. (2011) define it, on Python's integers."""
    word = 2**64 - 1
    x = [counter >> 64 * i & word for i in range(4)]
    k0, k1 = key & word, key >> 64
    for _ in range(10):
        product0, product1 = x[0] * 0xD2E7470EE14C6C93, x[2] * 0xCA5A826395121157
        x = [
            product1 >> 64 ^ x[1] ^ k0,
            product1 & word,
            product0 >> 64 ^ x[3] ^ k1,
            product0 & word,
        ]
        k0, k1 = k0 + 0x9E3779B97F4A7C15 & word, k1 + 0xBB67AE8584CAA73B & word
    return x


def test_keys_are_pinned() -> None:
    assert stream_key(1, Purpose.TRAINING, 2, 3).hex() == "afe8fb157dd415ea980ef11843bcd4fe"
    assert stream_key(0, Purpose.INITIALISE).hex() == "fbab3f70080a2db7f735e243bc872fbc"


def test_numbers_are_pinned() -> None:
    stream = Stream(stream_key(1, Purpose.TRAINING, 2, 3))
    assert stream.uniforms(3).tolist() == [
        0.8369767313544794,
        0.4503427258385444,
        0.9481946675128453,
    ]
    assert stream.integers(3, 1_000_000, 10_000_000).tolist() == [6970033, 3536741, 9531674]


def test_numbers_are_philox_with_a_counter_from_one() -> None:
    key = stream_key(7, Purpose.EPISODE, 11, 13)
    words = [
        word
        for counter in range(1, 26)
        for word in philox4x64(int.from_bytes(key, "little"), counter)
    ]
    assert Stream(key).uniforms(100).tolist() == [(word >> 11) / 2**53 for word in words]


def test_numbers_drawn_in_parts_equal_those_drawn_at_once() -> None:
    key = stream_key(1, Purpose.EPISODE)
    parts, whole = Stream(key), Stream(key).uniforms(1024)
    cuts = [0, 1, 3, 6, 513, 1024]
    for start, stop in pairwise(cuts):
        np.testing.assert_array_equal(parts.uniforms(stop - start), whole[start:stop])


def test_uniforms_fill_the_unit_interval_and_stay_below_one() -> None:
    numbers = Stream(stream_key(1, Purpose.PROBE)).uniforms(100_000)
    assert numbers.dtype == np.float64
    assert 0 <= numbers.min() < 1e-4
    assert 1 - 1e-4 < numbers.max() < 1
    assert abs(numbers.mean() - 0.5) < 5 / np.sqrt(12 * 100_000)


def test_integers_are_uniform_in_a_half_open_range() -> None:
    numbers = Stream(stream_key(1, Purpose.PROBE)).integers(60_000, -2, 4)
    values, counts = np.unique(numbers, return_counts=True)
    assert values.tolist() == [-2, -1, 0, 1, 2, 3]
    assert np.abs(counts - 10_000).max() < 5 * np.sqrt(10_000)


@pytest.mark.parametrize(
    "other",
    [
        (2, Purpose.EPISODE, 3, 4),
        (1, Purpose.COMMANDS, 3, 4),
        (1, Purpose.EPISODE, 4, 4),
        (1, Purpose.EPISODE, 3, 5),
        (1, Purpose.EPISODE, 34, 0),
        (13, Purpose.EPISODE, 4, 0),
    ],
)
def test_every_part_of_the_address_changes_the_stream(
    other: tuple[int, Purpose, int, int],
) -> None:
    assert stream_key(1, Purpose.EPISODE, 3, 4) != stream_key(*other)
