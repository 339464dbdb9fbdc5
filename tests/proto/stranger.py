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
import onnx
import onnxruntime
import safetensors.numpy
import zenoh

Weights = Mapping[str, npt.NDArray[np.float32]]
MASK = 2**64 - 1
DTYPES = {"vector": "<f4", "image": "|u1", "category": "<i4"}


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


class Network:
    """The graph of a run with the weights of one version."""

    def __init__(self, graph: bytes, weights: Weights) -> None:
        model = onnx.load_model_from_string(graph)
        for tensor in model.graph.initializer:
            if not tensor.raw_data:
                assert weights[tensor.name].shape == tuple(tensor.dims)
                tensor.raw_data = weights[tensor.name].astype("<f4").tobytes()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(model.SerializeToString(), options)

    def logits(self, observation: npt.NDArray[Any], desired: list[float]) -> npt.NDArray[Any]:
        """Return the logits of one row."""
        row = {"observation": observation[None], "command": np.array([desired], np.float64)}
        (found,) = self._session.run(["logits"], row)
        logits: npt.NDArray[Any] = found[0]
        return logits


def seen(observations: list[npt.NDArray[Any]], stack: int) -> npt.NDArray[Any]:
    """Return the most recent observations, oldest first; the first stands for those before it."""
    last = len(observations) - 1
    return np.concatenate(
        [np.atleast_1d(observations[max(last - k, 0)]) for k in reversed(range(stack))]
    )


def choose(row: list[float], u: float, temperature: float) -> int:
    if temperature == 0:
        return row.index(max(row))
    total, cumulative = 0.0, []
    for x in row:
        total += math.exp((x - max(row)) / temperature)
        cumulative.append(total)
    return min(sum(c <= u * total for c in cumulative), len(row) - 1)


def as_promised(observation: Any, spec: dict[str, Any]) -> npt.NDArray[Any]:
    """Return an observation of an environment as its space says."""
    kind = spec["observation_space"]["kind"]
    array = np.asarray(observation, DTYPES[kind])
    if kind == "image":
        array = np.moveaxis(array if array.ndim == 3 else array[..., None], -1, 0)
    return array


def run_episode(
    command: dict[str, Any], hello: dict[str, Any], network: Network | None
) -> dict[str, Any]:
    """Carry out a command and return the arrays and flags of its episode."""
    config, spec = hello["config"], hello["environment"]
    n_actions = spec["action_space"]["n"]
    limited = {"max_episode_steps": command["max_steps"]} | config["environment_kwargs"]
    env = gym.make(config["environment"], **limited)
    u = numbers(command["stream_key"], command["max_steps"])
    begins = numbers(hashlib.sha256(command["stream_key"]).digest()[:16], command["max_steps"])
    begun = held_until = 0
    desired, horizon = command["desired_return"], float(command["desired_horizon"])
    observation, _ = env.reset(seed=command["environment_seed"])
    observations: list[npt.NDArray[Any]] = []
    actions: list[int] = []
    rewards: list[np.float32] = []
    terminated = truncated = False
    while not (terminated or truncated):
        if command["cap"] is not None:
            desired = min(desired, command["cap"])
        observations.append(as_promised(observation, spec))
        t = len(actions)
        since = t - command["random_from"]
        if command["random_rate"] and t >= held_until and begins[t] < command["random_rate"]:
            begun = t
            multiple = math.floor(1 / (1 - begins[t] / command["random_rate"]))
            held_until = t + command["random_hold"] * multiple
        if t < held_until:
            action = int(u[begun] * n_actions)
        elif not command["random_rate"] and 0 <= since < command["random_steps"]:
            action = int(u[t - since % command["random_hold"]] * n_actions)
        else:
            assert network is not None
            stacked = seen(observations, config["frame_stack"])
            row = network.logits(stacked, [desired, horizon]).tolist()
            action = choose(row, u[t], command["temperature"])
        actions.append(action)
        observation, reward, terminated, truncated, _ = env.step(action)
        rewards.append(np.float32(reward))
        desired -= float(rewards[-1])
        horizon -= 1
    env.close()
    return {
        "observations": np.array(observations),
        "actions": np.array(actions, "|u1" if n_actions <= 256 else "<i4"),
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


def probe_weights(graph: bytes) -> Weights:
    tensors = onnx.load_model_from_string(graph).graph.initializer
    shapes = {t.name: tuple(t.dims) for t in tensors if not t.raw_data}
    weights = {}
    for k, name in enumerate(sorted(shapes, key=str.encode)):
        shape = shapes[name]
        scale = 1 / math.sqrt(math.prod(shape[1:]))
        drawn = numbers(stream_key(0, "probe", 0, k), math.prod(shape))
        weights[name] = np.array([(u * 2 - 1) * scale for u in drawn], "<f4").reshape(shape)
    return weights


def probe_rows(hello: dict[str, Any]) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Return what the network sees in 16 rows, and their commands."""
    spec = hello["environment"]
    space, stack = spec["observation_space"], hello["config"]["frame_stack"]
    names = ("size", "channels", "height", "width")
    first, *rest = [space[name] for name in names if name in space] or [1]
    shape = (16, stack * first, *rest)
    drawn = numbers(stream_key(0, "probe", 2, 0), math.prod(shape) + 32)
    observed, desired = drawn[:-32], drawn[-32:]
    if space["kind"] == "image":
        observation = np.array([math.floor(u * 256) for u in observed], "|u1")
    elif space["kind"] == "category":
        observation = np.zeros(len(observed), "<i4")
    else:
        observation = np.array([u * 4 - 2 for u in observed], "<f4")
    command = np.array([u * 200 - 100 for u in desired], "<f8")
    return observation.reshape(shape), command.reshape(16, 2)


def probe_logits(hello: dict[str, Any]) -> npt.NDArray[Any]:
    network = Network(hello["graph"], probe_weights(hello["graph"]))
    rows = zip(*probe_rows(hello), strict=True)
    return np.array([network.logits(s, c.tolist()) for s, c in rows], "<f4")


def numerics_class(hello: dict[str, Any]) -> str:
    logits = probe_logits(hello)
    drawn = numbers(stream_key(0, "probe", 3, 0), 64)
    actions = [choose(logits[k % 16].tolist(), u, 1.0) for k, u in enumerate(drawn)]
    dtype = "|u1" if logits.shape[1] <= 256 else "<i4"
    return arrays_digest({"actions": np.array(actions, dtype), "logits": logits}).hex()[:16]


def environment_digest(hello: dict[str, Any]) -> str:
    n = min(64, hello["environment"]["max_episode_steps"])
    command = {
        "desired_return": 0.0,
        "desired_horizon": 0,
        "max_steps": n,
        "environment_seed": 1_000_000,
        "stream_key": stream_key(0, "probe", 1, 0),
        "temperature": 1.0,
        "cap": None,
        "random_from": 0,
        "random_steps": n,
        "random_hold": 1,
        "random_rate": 0.0,
    }
    return episode_digest(0, run_episode(command, hello, None)).hex()[:16]


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
    assert run.startswith("udrl/2/")
    hello = msgpack.unpackb(reply.ok.payload.to_bytes())
    join = {
        "role": "actor",
        "id": "stranger",
        "host": "elsewhere",
        "pid": 1,
        "software": "from the page",
        "environments": 3,
        "numerics_class": numerics_class(hello),
        "environment_digest": environment_digest(hello),
        "environment": hello["environment"],
    }
    ask(session, f"{run}/join", join)
    token = session.liveliness().declare_token(f"{run}/alive/actor/stranger")
    news = threading.Event()
    subscriber = session.declare_subscriber(f"{run}/news/weights", lambda _: news.set())
    kept: dict[int, Network | None] = {0: None}
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
                kept[version] = Network(hello["graph"], safetensors.numpy.load(blob))
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
