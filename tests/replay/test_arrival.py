"""Checks of an episode before it is admitted to the run."""

from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from udrl.actions import Categorical
from udrl.digests import episode_digest
from udrl.environments import EnvironmentSpec
from udrl.episode import Episode
from udrl.errors import InvalidMessage
from udrl.replay_buffer import Entry
from udrl.spaces import Vector
from udrl_proto.codec import decode, decode_episode, encode_array, encode_episode
from udrl_proto.messages import ArrayMessage, EpisodeMessage
from udrl_replay.arrival import inspect_episode

SPEC = EnvironmentSpec(
    observation_space=Vector(size=2), action_space=Categorical(n=3), max_episode_steps=4
)


def episode(**changes: Any) -> Episode:
    """Return a valid episode of three steps with some parts replaced."""
    parts: dict[str, Any] = {
        "command_id": 7,
        "observations": np.arange(6, dtype=np.float32).reshape(3, 2),
        "actions": np.array([0, 1, 2], np.uint8),
        "rewards": np.array([0.5, -1.0, 2.0], np.float32),
        "terminated": True,
        "truncated": False,
    }
    return Episode(**{**parts, **changes})


def message(made: Episode) -> EpisodeMessage:
    return decode(encode_episode(made, "actor-1"), EpisodeMessage)


def test_valid_episode_has_return_length_and_digest() -> None:
    arrival = inspect_episode(message(episode()), SPEC)
    assert arrival.actor == "actor-1"
    assert arrival.entry == Entry(1.5, 7, 3)
    assert arrival.digest == episode_digest(episode())
    stored = decode_episode(decode(arrival.body, EpisodeMessage), SPEC.observation_space)
    assert episode_digest(stored) == arrival.digest


@pytest.mark.parametrize("flags", [(True, False), (False, True), (True, True)])
def test_episode_may_terminate_or_be_truncated_or_both(flags: tuple[bool, bool]) -> None:
    made = episode(terminated=flags[0], truncated=flags[1])
    assert inspect_episode(message(made), SPEC).digest == episode_digest(made)


def test_digest_does_not_depend_on_the_actor() -> None:
    theirs = replace(message(episode()), actor="actor-2")
    assert inspect_episode(theirs, SPEC).digest == inspect_episode(message(episode()), SPEC).digest


def ones(*shape: int) -> np.typing.NDArray[np.float32]:
    return np.ones(shape, np.float32)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"rewards": ones(5)}, r"rewards are float32 \(5,\), .* one dimension of 1 to 4 steps"),
        ({"rewards": ones(3, 1)}, r"rewards are float32 \(3, 1\), expected float32, one dimension"),
        ({"rewards": ones()}, r"rewards are float32 \(\), expected float32, one dimension"),
        ({"rewards": ones(2)}, r"observations are float32 \(3, 2\), expected float32 \(2, 2\)"),
        ({"rewards": np.ones(3, np.int32)}, r"rewards are int32 \(3,\), expected float32"),
        ({"observations": ones(2, 2)}, r"observations are float32 \(2, 2\), expected .* \(3, 2\)"),
        ({"observations": ones(3, 1)}, r"observations are float32 \(3, 1\), expected .* \(3, 2\)"),
        ({"observations": ones(6)}, r"observations are float32 \(6,\), expected .* \(3, 2\)"),
        ({"observations": ones(3, 2).astype(np.uint8)}, r"observations are uint8 .* float32"),
        ({"actions": np.zeros(2, np.uint8)}, r"actions are uint8 \(2,\), expected uint8 \(3,\)"),
        ({"actions": np.zeros((3, 1), np.uint8)}, r"actions are uint8 \(3, 1\), expected uint8"),
        ({"actions": np.zeros(3, np.int32)}, r"actions are int32 \(3,\), expected uint8 \(3,\)"),
        ({"actions": np.array([0, 3, 1], np.uint8)}, "actions are from 0 to 3, expected 0 to 2"),
        ({"rewards": ones(3) * np.nan}, "rewards are not all finite"),
        ({"rewards": np.array([0, -np.inf, 0], np.float32)}, "rewards are not all finite"),
        ({"observations": ones(3, 2) * np.inf}, "observations are not all finite"),
        ({"observations": ones(3, 2) * np.nan}, "observations are not all finite"),
        ({"terminated": False}, "it neither terminated nor was truncated"),
    ],
)
def test_invalid_episode_is_rejected_with_the_fault(
    changes: dict[str, Any], complaint: str
) -> None:
    with pytest.raises(InvalidMessage, match=rf"^episode 7: {complaint}"):
        inspect_episode(message(episode(**changes)), SPEC)


def test_actions_of_large_action_spaces_are_signed_and_checked() -> None:
    spec = replace(SPEC, action_space=Categorical(n=1000))
    good = episode(actions=np.array([0, 1, 999], np.int32))
    assert inspect_episode(message(good), spec).entry.id == 7
    for bad in (-1, 1000):
        with pytest.raises(InvalidMessage, match=r"actions are from .*, expected 0 to 999"):
            inspect_episode(message(episode(actions=np.array([0, 1, bad], np.int32))), spec)


def test_array_whose_bytes_do_not_match_its_shape_is_rejected() -> None:
    short = ArrayMessage(dtype="<f4", shape=(3,), data=bytes(11))
    with pytest.raises(InvalidMessage, match=r"11 bytes for <f4 \[3\], expected 12"):
        inspect_episode(replace(message(episode()), rewards=short), SPEC)


def test_return_is_summed_in_order_in_float64() -> None:
    rewards = np.array([1e8, 1.0, -1e8], np.float32)
    assert inspect_episode(message(episode(rewards=rewards)), SPEC).entry.episode_return == 1.0


def test_longest_episode_is_accepted() -> None:
    made = episode(
        observations=ones(4, 2), actions=np.zeros(4, np.uint8), rewards=ones(4), truncated=True
    )
    assert inspect_episode(message(made), SPEC).entry.length == SPEC.max_episode_steps
    assert encode_array(made.rewards).shape == (4,)
