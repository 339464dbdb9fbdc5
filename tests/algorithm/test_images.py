"""Behavior function, training and checkpoints for images; settings that depend on the machine."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch

from udrl import numerics
from udrl.actions import Categorical
from udrl.behavior import BehaviorFunction, initialise
from udrl.checkpoint import decode_state, encode_optimizer
from udrl.commands import CommandSampler
from udrl.config import Config, build
from udrl.digests import arrays_digest
from udrl.environments import EnvironmentSpec
from udrl.episode import Episode
from udrl.experience import Experience
from udrl.numerics import resolve_arithmetic, resolve_as
from udrl.replay_buffer import Entry, ReplayBuffer
from udrl.spaces import Image
from udrl.training import train, untrained
from udrl.training_class import training_class
from udrl.weights import encode_weights

TAKE_COVER = EnvironmentSpec(
    observation_space=Image(channels=1, height=32, width=32),
    action_space=Categorical(n=2),
    max_episode_steps=2100,
)
# Appendix B.2.
CONVOLUTIONS = [(32, 48, 96, 128), (32, 64, 128, 256), (48, 96, 192, 384)]
FULLY_CONNECTED = [(64, 128), (64, 128, 128), (128, 256), (128, 256, 256), (128, 128), (256, 256)]
PRECISIONS = ["float32", "bfloat16"]


def settings(**values: Any) -> Config:
    small = {
        "environment": "TakeCover-v0", "frame_stack": 8, "batch_size": 16, "n_updates_per_iter": 3,
        "return_scale": 0.1,
    }  # fmt: skip
    return build(Config, small | values)


def images(n: int, spec: EnvironmentSpec = TAKE_COVER, stack: int = 8) -> torch.Tensor:
    channels, *size = spec.observation_space.shape
    rng = np.random.default_rng(n)
    return torch.tensor(rng.integers(0, 256, (n, stack * channels, *size)).astype(np.uint8))


def commands(n: int) -> torch.Tensor:
    return torch.tensor(np.random.default_rng(n).standard_normal((n, 2)), dtype=torch.float32)


def relu(x: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.maximum(x, 0.0)


def convolve(
    x: npt.NDArray[np.float64], weight: npt.NDArray[np.float64], bias: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """3x3 filters, 1 pixel of padding in all directions, stride of 2 pixels; one at a time."""
    _, height, width = x.shape
    padded = np.pad(x, ((0, 0), (1, 1), (1, 1)))
    return np.array(
        [
            [
                [
                    np.sum(padded[:, 2 * i : 2 * i + 3, 2 * j : 2 * j + 3] * w) + b
                    for j in range((width + 1) // 2)
                ]
                for i in range((height + 1) // 2)
            ]
            for w, b in zip(weight, bias, strict=True)
        ]
    )


def appendix_b_2(behavior: BehaviorFunction, image: torch.Tensor, command: torch.Tensor) -> Any:
    """One image, in float64."""
    held = {n: t.numpy().astype(np.float64) for n, t in behavior.state_dict().items()}
    x = image.numpy() / 255
    n_convolutions = sum(n.startswith("encoder.") for n in held) // 2
    for i in range(n_convolutions):
        weight, bias = (held[f"encoder.layers.{i}.{name}"] for name in ("weight", "bias"))
        x = relu(convolve(x, weight, bias))
    gate = 1 / (1 + np.exp(-held["command.weight"] @ command.numpy() - held["command.bias"]))
    y = x.reshape(-1) * gate
    for i in range(len(behavior.layers)):
        y = relu(held[f"layers.{i}.weight"] @ y + held[f"layers.{i}.bias"])
    return held["action.weight"] @ y + held["action.bias"]


@pytest.mark.parametrize("size", [(1, 32, 32), (3, 9, 14)])
@pytest.mark.parametrize("initialisation", ["orthogonal", "uniform"])
def test_logits_equal_the_formulas_of_appendix_b_2(
    size: tuple[int, ...], initialisation: str
) -> None:
    spec = EnvironmentSpec(
        observation_space=Image(channels=size[0], height=size[1], width=size[2]),
        action_space=Categorical(n=3),
        max_episode_steps=9,
    )
    config = settings(
        convolutions=(3, 4, 5, 6), hidden=(8, 7), frame_stack=2, initialisation=initialisation
    )
    behavior = initialise(config, spec)
    seen, given = images(4, spec, stack=2), commands(4)
    with torch.inference_mode():
        logits = behavior((seen,), given)
    expected = [appendix_b_2(behavior, *row) for row in zip(seen, given, strict=True)]
    np.testing.assert_allclose(logits.numpy(), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("hidden", FULLY_CONNECTED, ids=str)
@pytest.mark.parametrize("convolutions", CONVOLUTIONS, ids=str)
def test_layers_have_the_sizes_of_appendix_b_2(
    convolutions: tuple[int, ...], hidden: tuple[int, ...]
) -> None:
    config = settings(convolutions=convolutions, hidden=hidden)
    shapes = {n: tuple(t.shape) for n, t in initialise(config, TAKE_COVER).state_dict().items()}
    into = [8, *convolutions]
    flat = 4 * convolutions[-1]  # 32 -> 16 -> 8 -> 4 -> 2 pixels
    weights: dict[str, tuple[int, ...]] = {
        f"encoder.layers.{i}.weight": (into[i + 1], into[i], 3, 3) for i in range(4)
    }
    weights |= {"command.weight": (flat, 2), "action.weight": (2, hidden[-1])}
    units = [flat, *hidden]
    weights |= {f"layers.{i}.weight": (units[i + 1], units[i]) for i in range(len(hidden))}
    assert {n: s for n, s in shapes.items() if "weight" in n} == weights


def test_bfloat16_is_close_to_float32() -> None:
    given = (images(32),), commands(32)
    logits = {}
    for precision in PRECISIONS:
        with torch.inference_mode():
            logits[precision] = initialise(settings(precision=precision), TAKE_COVER)(*given)
    apart = (logits["bfloat16"] - logits["float32"]).abs().max()
    assert 0 < apart < 0.1 * logits["float32"].abs().max()


def some_episodes(n: int, longest: int = 70) -> list[Episode]:
    rng = np.random.default_rng(1)
    episodes = []
    for i in range(n):
        length = int(rng.integers(10, longest))
        actions = rng.integers(0, 2, length).astype(np.uint8)
        observations = rng.integers(0, 100, (length, 1, 32, 32)).astype(np.uint8)
        observations[:, :, :8] += 100 * actions[:, None, None, None]  # the pattern to learn
        episodes.append(
            Episode(i, observations, actions, np.ones(length, np.float32), True, False)  # noqa: FBT003
        )
    return episodes


@pytest.mark.parametrize("precision", ["float32", pytest.param("bfloat16", marks=pytest.mark.slow)])
def test_training_learns_and_resumes_from_a_checkpoint(precision: str) -> None:
    config = settings(precision=precision, learning_rate=3e-3, n_updates_per_iter=60)
    experience = Experience(config, TAKE_COVER)
    for episode in some_episodes(5):
        experience.add(episode)
    ranked = experience.by_rank(list(range(5)))
    state = untrained(config, TAKE_COVER)
    train(state, ranked, config)
    restored = decode_state(
        1, encode_weights(state.weights), encode_optimizer(state), config, TAKE_COVER
    )
    for one in (state, restored):
        train(one, ranked, config)
    digests = {arrays_digest(one.weights) for one in (state, restored)}
    assert len(digests) == 1
    assert state.loss < 0.3, "nats; chance level is 0.69"
    assert all(p.dtype == torch.float32 for p in state.behavior.parameters())


def test_numerics_class_depends_on_the_precision() -> None:
    classes = {p: training_class(settings(precision=p), TAKE_COVER) for p in PRECISIONS}
    assert len(set(classes.values())) == 2


def test_buffer_stores_single_frames() -> None:
    """500 episodes of 800 steps take at most 0.6 GB, in pages that are allocated as they fill."""
    config = settings(replay_size=500)
    experience = Experience(config, TAKE_COVER)
    seen, done = TAKE_COVER.observation_space, TAKE_COVER.action_space
    experience.add(
        Episode(
            command_id=0,
            observations=np.zeros((800, *seen.shape), seen.dtype),
            actions=np.zeros(800, done.dtype),
            rewards=np.zeros(800, np.float32),
            terminated=True,
            truncated=False,
        )
    )
    kept = [a for a in vars(experience).values() if isinstance(a, np.ndarray)]
    per_step = sum(a.nbytes for a in kept) / len(experience._observations)
    in_pages = -(-800 // 64) * 64
    assert 500 * in_pages * per_step < 0.6e9


# Settings that depend on the machine.


def test_auto_selects_precision_and_device_of_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    automatic = settings(precision="auto", device="auto")
    for fast, cuda in ((True, False), (False, True)):
        monkeypatch.setattr(numerics, "_is_fast_in_bfloat16", lambda fast=fast: fast)
        monkeypatch.setattr(numerics, "has_cuda", lambda cuda=cuda: cuda)
        resolved = resolve_arithmetic(automatic)
        assert resolved.arithmetic.precision == ("bfloat16" if fast else "float32")
        assert resolved.arithmetic.device == ("cuda" if cuda else "cpu")
        assert resolve_arithmetic(resolved) == resolved


def test_resumed_run_keeps_its_precision_and_device() -> None:
    held = settings(precision="bfloat16", device="cpu", seed=3)
    assert resolve_as(held, settings(precision="auto", device="auto", seed=3)) == held
    requested = settings(precision="float32", device="auto", seed=3)
    assert resolve_as(held, requested).arithmetic.precision == "float32"


@pytest.mark.parametrize(
    ("text", "fast"),
    [
        ("flags : fpu avx512_bf16 sse", True),
        ("Features : fp asimd bf16", True),
        ("flags : fpu bf16x", False),
    ],
)
def test_precision_follows_the_processors_features(
    text: str, fast: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Path, "read_text", lambda *_, **__: text)
    assert numerics._is_fast_in_bfloat16() is fast


def test_precision_is_float32_where_the_features_are_unknown(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def missing(*_: object, **__: object) -> str:
        raise FileNotFoundError

    monkeypatch.setattr(Path, "read_text", missing)
    assert not numerics._is_fast_in_bfloat16()


# Commands of TakeCover (3.1): the horizon is the return, as an integer.


def test_horizon_is_the_return_as_an_integer() -> None:
    config = settings(horizon_equals_return=True, replay_size=10, last_few=4)
    buffer = ReplayBuffer(config.buffer)
    buffer.admit([Entry(float(r), i, r) for i, r in enumerate((200, 301, 350, 412))])
    sampler = CommandSampler(config, TAKE_COVER)
    explored = sampler.explore(1, buffer)
    assert len({c.desired_return for c in explored}) > 5
    for command in (*explored, *sampler.evaluate(1, buffer)):
        assert command.desired_return == command.desired_horizon
        assert 315 <= command.desired_return <= 315.75 + 78.1
    assert {c.desired_return for c in sampler.evaluate(1, buffer)} == {315.0}
