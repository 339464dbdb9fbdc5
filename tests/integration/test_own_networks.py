"""Custom behavior functions, with and without torch and their class."""

import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.algorithm1 import algorithm1
from udrl.behavior import initialise
from udrl.checkpoint import decode_state, encode_optimizer
from udrl.commands import CommandSampler
from udrl.config import Budget, Config, build
from udrl.environments.making import make_environment
from udrl.environments.specification import specify
from udrl.errors import ConfigError
from udrl.experience import Experience
from udrl.graph import acting_graph, weight_shapes
from udrl.inference import ActingFunction
from udrl.training import train, untrained, weights_of
from udrl.weights import encode_weights
from udrl_inspect.agents import load_agent
from udrl_inspect.exporting import export_folder
from udrl_proto.reports import Status
from whole_run import SMALL, digests, reference

Runner = Callable[..., Status]


def settings(name: str = "Concatenating", **values: Any) -> Config:
    return build(
        Config,
        SMALL | {"behavior": f"own_networks:{name}", "lead": 0, "baseline": "value"} | values,
    )


@pytest.mark.parametrize(
    ("baseline", "guidance_kl"), [("none", 0), ("none", 0.03), ("value", 0), ("value", 0.03)]
)
@pytest.mark.parametrize("frame_stack", [1, 2])
def test_graph_equals_the_module(baseline: str, guidance_kl: float, frame_stack: int) -> None:
    config = settings(baseline=baseline, guidance_kl=guidance_kl, frame_stack=frame_stack)
    spec = specify(make_environment(config), config)
    behavior, graph = initialise(config, spec), acting_graph(config.network, spec)
    if behavior.guidance is not None:
        behavior.guidance.copy_(torch.tensor([[1.5, -1.0]]))
    weights = weights_of(behavior)
    assert weight_shapes(graph) == {n: t.shape for n, t in weights.items()}
    function, rng = ActingFunction(graph, weights), np.random.default_rng(1)
    seen = (rng.standard_normal((20, 4 * frame_stack), np.float32),)
    command = np.tile([[50.0, 60.0]], (20, 1))
    scaled = command * [config.network.return_scale, config.network.horizon_scale]
    with torch.inference_mode():
        shown = tuple(map(torch.from_numpy, seen))
        expected = behavior(shown, torch.from_numpy(scaled).float()).numpy()
    np.testing.assert_allclose(function.logits(seen, command), expected, rtol=1e-4, atol=1e-5)


def test_run_equals_the_reference_and_its_folder_needs_no_class(
    run: Runner, tmp_path: Path
) -> None:
    config, run_dir = settings(), tmp_path / "run"
    status = run(config, 3000, run_dir=run_dir)
    assert digests(status) == digests(reference(config, 3000))
    agent = load_agent(run_dir)
    export_folder(agent, run_dir, tmp_path / "folder")
    logits = agent.policy.logits([0.1, 0.2, 0.3, 0.4], 50.0, 50).tolist()
    program = (
        "import sys, udrl\n"
        f"policy = udrl.load({str(tmp_path / 'folder')!r})\n"
        "print(policy.logits([0.1, 0.2, 0.3, 0.4], 50.0, 50).tolist())\n"
        "assert 'torch' not in sys.modules and 'own_networks' not in sys.modules\n"
    )
    found = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True
    )
    assert found.stdout.strip() == str(logits)


def test_initial_weights_are_a_function_of_the_seed() -> None:
    def weights(seed: int) -> Any:
        config = settings(seed=seed)
        spec = specify(make_environment(config), config)
        return weights_of(initialise(config, spec))["custom.first.weight"].tolist()

    torch.manual_seed(5)
    before = torch.random.get_rng_state()
    assert weights(1) == weights(1) != weights(2)
    assert torch.equal(torch.random.get_rng_state(), before)


def test_initial_weights_are_those_of_the_module_and_all_are_trained() -> None:
    config = settings("Initialised", baseline="none", warm_up_hold_steps=1)
    with closing(EpisodeGenerator(config, 1)) as generator:
        spec, commands = generator.spec, CommandSampler(config, generator.spec).warm_up()
        episodes = generate_episodes(generator, commands, None)
    state = untrained(config, spec)
    initial = state.weights
    first = initial["custom.first.weight"]
    np.testing.assert_array_equal(first, np.eye(*first.shape))
    assert (initial["custom.first.bias"] == 0.5).all()
    held = Experience(config, spec)
    for episode in episodes:
        held.add(episode)
    train(state, held.by_rank([episode.command_id for episode in episodes]), config)
    restored = decode_state(1, encode_weights(state.weights), encode_optimizer(state), config, spec)
    for name, tensor in state.weights.items():
        np.testing.assert_array_equal(restored.weights[name], tensor)
        assert (tensor != initial[name]).any(), name


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("NoSuchClass", "AttributeError.*importable here, as package.module:Class"),
        ("NoModule", "is NoModule, expected a torch.nn.Module"),
        ("Idle", "its parameters idle.bias, idle.weight have no effect"),
        ("Persistent", r"kept would not be trained; .*persistent=False"),
        ("Narrow", r"returns torch.float32 \(2, 1\) for a batch of 2, expected .* \(2, 2\)"),
        ("Broken", "cannot be computed or exported: RuntimeError: not today"),
    ],
)
def test_invalid_module_is_rejected_when_the_run_is_created(name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        algorithm1(settings(name), Budget(max_env_steps=100))


def test_custom_module_has_no_memory() -> None:
    with pytest.raises(ConfigError, match="a network of your own has no memory"):
        settings(memory="gru")
