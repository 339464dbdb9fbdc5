"""An actor written from ``proto/README.md`` alone: nothing of this project is imported."""

import hashlib
import math
import struct
import threading
import time
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import msgpack
import numpy as np
import numpy.typing as npt
import safetensors.torch
import torch
import zenoh

Weights = Mapping[str, torch.Tensor]
MASK = 2**64 - 1


# Random streams.


def stream_key(seed: int, purpose: str, iteration: int, index: int) -> bytes:
    name = f"udrl/stream/1|{seed}|{purpose}|{iteration}|{index}"
    return hashlib.sha256(name.encode()).digest()[:16]


def philox(key: bytes, n: int) -> list[int]:
    words: list[int] = []
    for counter in range(1, 1 + -(-n // 4)):
        c0, c1, c2, c3 = counter, 0, 0, 0
        k0, k1 = int.from_bytes(key[:8], "little"), int.from_bytes(key[8:], "little")
        for _ in range(10):
            a, b = c0 * 0xD2E7470EE14C6C93, c2 * 0xCA5A826395121157
            c0, c1, c2, c3 = (b >> 64) ^ c1 ^ k0, b & MASK, (a >> 64) ^ c3 ^ k1, a & MASK
            k0, k1 = (k0 + 0x9E3779B97F4A7C15) & MASK, (k1 + 0xBB67AE8584CAA73B) & MASK
        words += [c0, c1, c2, c3]
    return words[:n]


def numbers(key: bytes, n: int) -> list[float]:
    return [(word >> 11) * 2.0**-53 for word in philox(key, n)]


# Inference and the choice of an action.


def logits(weights: Weights, config: dict[str, Any], s: torch.Tensor, c: torch.Tensor) -> Any:
    """Return the logits of ``inference_rows`` rows."""
    f = {"relu": torch.relu, "tanh": torch.tanh}[config["activation"]]

    def layer(name: str, x: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.linear(x, weights[f"{name}.weight"], weights[f"{name}.bias"])

    if config["baseline"] == "value":
        v = torch.tanh(layer("value.hidden", torch.tanh(layer("value.encoder.0", s))))
        value, deviation = layer("value.expected", v).unbind(1)
        above = (c[:, 0] - value) / (torch.nn.functional.softplus(deviation) + 0.003)
        c = torch.stack([above.clamp(-2, 2), c[:, 1]], 1)
    x = f(layer("observation", s)) * torch.sigmoid(layer("command", c))
    for i in range(len(config["hidden"]) - 1):
        x = f(layer(f"layers.{i}", x))
    return layer("action", x)


def choose(row: list[float], u: float, temperature: float) -> int:
    if temperature == 0:
        return row.index(max(row))
    total, cumulative = 0.0, []
    for x in row:
        total += math.exp((x - max(row)) / temperature)
        cumulative.append(total)
    return min(sum(c <= u * total for c in cumulative), len(row) - 1)


def run_episode(
    command: dict[str, Any], hello: dict[str, Any], weights: Weights | None
) -> dict[str, Any]:
    """Carry out a command and return the arrays and flags of its episode."""
    config, spec = hello["config"], hello["environment"]
    limited = {"max_episode_steps": command["max_steps"]} | config["environment_kwargs"]
    env = gym.make(config["environment"], **limited)
    u = numbers(command["stream_key"], command["max_steps"])
    desired, horizon = command["desired_return"], float(command["desired_horizon"])
    observation, _ = env.reset(seed=command["environment_seed"])
    observations: list[npt.NDArray[np.float32]] = []
    actions: list[int] = []
    rewards: list[np.float32] = []
    terminated = truncated = False
    while not (terminated or truncated):
        if command["kind"] == "evaluate" and spec["max_return"] is not None:
            desired = min(desired, spec["max_return"])
        row = [0.0] * spec["n_actions"]
        if weights is not None:
            s = torch.zeros(config["inference_rows"], *spec["observation_shape"])
            c = torch.zeros(config["inference_rows"], 2)
            s[0] = torch.from_numpy(np.asarray(observation, np.float32))
            scaled = config["return_scale"] * desired, config["horizon_scale"] * max(horizon, 1.0)
            c[0] = torch.tensor(scaled, dtype=torch.float64)
            row = logits(weights, config, s, c)[0].tolist()
        first = command["hold_from"]
        if first <= len(actions) < first + command["hold_steps"]:
            action = int(u[first] * spec["n_actions"])
        else:
            action = choose(row, u[len(actions)], command["temperature"])
        observations.append(np.asarray(observation, np.float32))
        actions.append(action)
        observation, reward, terminated, truncated, _ = env.step(action)
        rewards.append(np.float32(reward))
        desired -= float(rewards[-1])
        horizon -= 1
    env.close()
    return {
        "observations": np.array(observations, "<f4"),
        "actions": np.array(actions, "|u1" if spec["n_actions"] <= 256 else "<i4"),
        "rewards": np.array(rewards, "<f4"),
        "terminated": terminated,
        "truncated": truncated,
    }


# The probe.


def arrays_digest(arrays: Mapping[str, npt.NDArray[Any]]) -> bytes:
    sha = hashlib.sha256()
    for name in sorted(arrays):
        array = arrays[name]
        sha.update(f"{name}|{array.dtype.str}|{array.shape}|".encode() + array.tobytes())
    return sha.digest()


def episode_digest(command_id: int, episode: dict[str, Any]) -> bytes:
    arrays = {name: episode[name] for name in ("observations", "actions", "rewards")}
    flags = struct.pack("<Q??", command_id, episode["terminated"], episode["truncated"])
    return hashlib.sha256(flags + arrays_digest(arrays)).digest()


def initial_weights(config: dict[str, Any], spec: dict[str, Any]) -> Weights:
    (u,) = numbers(stream_key(config["seed"], "initialise", 0, 0), 1)
    generator = torch.Generator().manual_seed(math.floor(u * 2**52))
    h = config["hidden"]
    shapes = {"observation": (h[0], *spec["observation_shape"]), "command": (h[0], 2)}
    shapes |= {f"layers.{i}": (h[i + 1], h[i]) for i in range(len(h) - 1)}
    shapes["action"] = (spec["n_actions"], h[-1])
    weights: dict[str, torch.Tensor] = {}
    if config["baseline"] == "value":
        shapes |= {"value.encoder.0": (64, *spec["observation_shape"])}
        shapes |= {"value.hidden": (64, 64), "value.expected": (2, 64)}
    for name, (outputs, inputs) in shapes.items():
        weight, bias = torch.empty(outputs, inputs), torch.zeros(outputs)
        if config["initialisation"] == "orthogonal":
            outer = name in ("command", "action", "value.expected")
            gain = 1.0 if outer else torch.nn.init.calculate_gain(config["activation"])
            torch.nn.init.orthogonal_(weight, gain, generator)
        else:
            bound = inputs**-0.5
            torch.nn.init.uniform_(weight, -bound, bound, generator)
            torch.nn.init.uniform_(bias, -bound, bound, generator)
        weights |= {f"{name}.weight": weight, f"{name}.bias": bias}
    return weights


def numerics_class(hello: dict[str, Any]) -> str:
    config, spec = hello["config"], hello["environment"]
    weights = initial_weights(config, spec)

    def rows(index: int, width: int) -> torch.Tensor:
        n = config["inference_rows"]
        drawn = np.array(numbers(stream_key(0, "probe", 0, index), n * width)) * 4 - 2
        return torch.from_numpy(drawn.reshape(n, width).astype(np.float32))

    found = logits(weights, config, rows(0, *spec["observation_shape"]), rows(1, 2))
    n = min(64, spec["max_episode_steps"])
    command = {
        "kind": "explore",
        "desired_return": 1.0 / config["return_scale"],
        "desired_horizon": n,
        "max_steps": n,
        "environment_seed": 1_000_000,
        "stream_key": stream_key(0, "probe", 1, 0),
        "temperature": 1.0,
        "hold_from": 0,
        "hold_steps": 0,
    }
    episode = run_episode(command, hello, weights)
    digests = arrays_digest({"logits": found.numpy()}) + episode_digest(0, episode)
    return hashlib.sha256(digests).hexdigest()[:16]


# The life of an actor.


class Problem(Exception):
    """The answer is no; the argument is its code."""


def ask(session: zenoh.Session, key: str, request: dict[str, Any]) -> dict[str, Any]:
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        for reply in session.get(
            key,
            payload=msgpack.packb(request),
            timeout=3.0,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.BLOCK,
        ):
            if reply.ok is not None:
                answer: dict[str, Any] = msgpack.unpackb(reply.ok.payload.to_bytes())
                return answer
            assert reply.err is not None
            if reply.err.encoding == zenoh.Encoding.APPLICATION_OCTET_STREAM:
                raise Problem(msgpack.unpackb(reply.err.payload.to_bytes())["code"])
    raise TimeoutError(key)


def act(session: zenoh.Session) -> int:
    """Serve the only run on the router until it has ended; return the episodes delivered."""
    (reply,) = session.get("udrl/*/*/hello", payload=b"\x80", timeout=3.0)
    assert reply.ok is not None
    run = str(reply.ok.key_expr).removesuffix("/hello")
    assert run.startswith("udrl/1/")
    hello = msgpack.unpackb(reply.ok.payload.to_bytes())
    join = {
        "role": "actor",
        "id": "stranger",
        "host": "elsewhere",
        "pid": 1,
        "software": "from the page",
        "environments": 3,
        "numerics_class": numerics_class(hello),
        "environment": hello["environment"],
    }
    ask(session, f"{run}/join", join)
    token = session.liveliness().declare_token(f"{run}/alive/actor/stranger")
    news = threading.Event()
    subscriber = session.declare_subscriber(f"{run}/news/weights", lambda _: news.set())
    kept: dict[int, Weights | None] = {0: None}
    delivered = 0
    while True:
        reply_to = ask(session, f"{run}/commands", {"actor": "stranger", "wanted": 3})
        if reply_to.get("ended"):
            token.undeclare()
            subscriber.undeclare()
            return delivered
        if reply_to.get("wait"):
            news.wait(reply_to["wait"]["retry_after_s"])
            news.clear()
        for command in reply_to.get("commands", []):
            version = command["weights_version"]
            if version not in kept:
                blob = ask(session, f"{run}/weights", {"version": version})["weights"]
                kept[version] = safetensors.torch.load(blob)
            episode = run_episode(command, hello, kept[version])
            for name in ("observations", "actions", "rewards"):
                array = episode[name]
                episode[name] = {
                    "dtype": array.dtype.str,
                    "shape": array.shape,
                    "data": array.tobytes(),
                }
            ask(
                session,
                f"{run}/episode",
                {"actor": "stranger", "command_id": command["id"], **episode},
            )
            delivered += 1
