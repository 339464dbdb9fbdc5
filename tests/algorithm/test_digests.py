import hashlib
from typing import Any

import numpy as np
import pytest

from udrl.digests import arrays_digest, episode_digest, replay_digest
from udrl.episode import Episode


def episode(**values: Any) -> Episode:
    usual: dict[str, Any] = {
        "command_id": 5,
        "observations": np.array([[0.5, -1.0], [2.0, 0.0]], np.float32),
        "actions": np.array([1, 0], np.uint8),
        "rewards": np.array([1.0, -0.25], np.float32),
        "terminated": True,
        "truncated": False,
    }
    return Episode(**(usual | values))


def test_digests_are_pinned() -> None:
    assert episode_digest(episode()).hex() == (
        "66d2f4483f3a58ff5e178c7eb2afd30dd6a95f1004c43f197e60b81bff50cfb9"
    )
    assert replay_digest([b"a" * 32, b"b" * 32]).hex() == (
        "fdd2a64d014f2c406d2ece67c23212a92b356314f4deb42b24c395296ee304d2"
    )


def test_array_digest_covers_name_type_shape_and_bytes() -> None:
    array = np.array([[1, 2, 3], [4, 5, 6]], np.int16)
    expected = hashlib.sha256(b"x|<i2|(2, 3)|" + bytes([1, 0, 2, 0, 3, 0, 4, 0, 5, 0, 6, 0]))
    assert arrays_digest({"x": array}) == expected.digest()


def test_array_digest_ignores_order_of_names_and_memory_layout() -> None:
    a, b = np.arange(6, dtype=np.float32).reshape(2, 3), np.zeros(2)
    expected = arrays_digest({"a": a, "b": b})
    assert arrays_digest({"b": b, "a": a}) == expected
    assert arrays_digest({"a": np.asfortranarray(a), "b": b}) == expected
    assert arrays_digest({"a": a.astype(">f4"), "b": b}) == expected


@pytest.mark.parametrize(
    "other",
    [
        {"y": np.zeros(4, np.float32)},
        {"x": np.zeros(4, np.int32)},
        {"x": np.zeros((2, 2), np.float32)},
        {"x": np.zeros(3, np.float32)},
        {"x": np.array([0, 0, 0, 1e-45], np.float32)},
        {"x": np.zeros(4, np.float32), "y": np.zeros(0, np.float32)},
        {},
    ],
)
def test_different_arrays_have_different_digests(other: dict[str, Any]) -> None:
    assert arrays_digest(other) != arrays_digest({"x": np.zeros(4, np.float32)})


@pytest.mark.parametrize(
    "change",
    [
        {"command_id": 6},
        {"terminated": False},
        {"truncated": True},
        {"terminated": False, "truncated": True},
        {"observations": np.array([[0.5, -1.0], [2.0, -0.0]], np.float32)},
        {"actions": np.array([1, 1], np.uint8)},
        {"actions": np.array([1, 0], np.int32)},
        {"rewards": np.array([1.0, -0.5], np.float32)},
    ],
)
def test_different_episodes_have_different_digests(change: dict[str, Any]) -> None:
    assert episode_digest(episode(**change)) != episode_digest(episode())


def test_buffer_digest_depends_on_the_order_of_episodes() -> None:
    first, second = episode_digest(episode()), episode_digest(episode(command_id=6))
    assert replay_digest([first, second]) != replay_digest([second, first])
    assert replay_digest(iter([first, second])) == replay_digest([first, second])
