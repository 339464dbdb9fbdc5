"""An actor written from ``proto/README.md`` alone, without any import of udrl."""

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
DTYPES = {
    "vector": "<f4", "bits": "|u1", "image": "|u1", "category": "<i4", "categories": "<i4",
}  # fmt: skip


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


# Inference and action selection.


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

        self._names = [one.name for one in self._session.get_inputs()]
        self._outputs = [one.name for one in self._session.get_outputs()]
        ends = self._session.get_inputs()[-1]
        self.state_size = ends.shape[1] if ends.name == "state" else 0

    def logits(
        self, shown: list[npt.NDArray[Any]], desired: list[float], state: npt.NDArray[Any]
    ) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        """Return the logits of one row, and the state at the next step."""
        given = [*(one[None] for one in shown), np.array([desired], np.float64)]
        given += [state[None]] if self.state_size else []
        found = self._session.run(self._outputs, dict(zip(self._names, given, strict=True)))
        return found[0][0], found[1][0] if self.state_size else state


def leaves(spec: dict[str, Any]) -> list[tuple[list[Any], dict[str, Any]]]:
    """Return path and space of each leaf of the observations."""
    space = spec["observation_space"]
    if space["kind"] != "record":
        return [([], space)]
    return [(list(leaf["path"]), leaf["space"]) for leaf in space["leaves"]]


def stack_observations(
    observations: list[list[npt.NDArray[Any]]], stack: int
) -> list[npt.NDArray[Any]]:
    """Return the most recent of each leaf, oldest first; the first fills the stack."""
    recent = [observations[max(len(observations) - 1 - k, 0)] for k in reversed(range(stack))]
    return [np.concatenate(list(map(np.atleast_1d, one))) for one in zip(*recent, strict=True)]


def choose(row: list[float], u: float, temperature: float) -> int:
    if temperature == 0:
        return row.index(max(row))
    total, cumulative = 0.0, []
    for x in row:
        total += math.exp((x - max(row)) / temperature)
        cumulative.append(total)
    return min(sum(c <= u * total for c in cumulative), len(row) - 1)


def convert_observation(
    observation: Any, space: Any, spec: dict[str, Any]
) -> list[npt.NDArray[Any]]:
    """Convert an environment's observation to leaves of the declared dtypes and shapes."""
    found = []
    for path, leaf in leaves(spec):
        value, of = observation, space
        for key in path:
            value, of = value[key], of[key]
        array = np.asarray(value)
        if leaf["kind"] in ("category", "categories"):
            array = array - of.start
        array = array.astype(DTYPES[leaf["kind"]])
        if leaf["kind"] == "image":
            array = np.moveaxis(array if array.ndim == 3 else array[..., None], -1, 0)
        elif leaf["kind"] != "category":
            array = array.reshape(-1)
        found.append(array)
    return found


def encode_observations(
    steps: list[list[npt.NDArray[Any]]], spec: dict[str, Any]
) -> npt.NDArray[Any]:
    """Return an episode's observations in wire format."""
    if spec["observation_space"]["kind"] != "record":
        return np.array([one for (one,) in steps])
    rows = [b"".join(leaf.tobytes() for leaf in step) for step in steps]
    return np.frombuffer(b"".join(rows), f"|V{len(rows[0])}")


def components(spec: dict[str, Any]) -> list[int]:
    """Return the number of values of each component of an action."""
    space = spec["action_space"]
    return list(space["ns"]) if space["kind"] == "product" else [space["n"]]


def is_box(space: Any) -> bool:
    return isinstance(space, gym.spaces.Box)


def nested_spaces(space: Any) -> list[Any]:
    """Return the spaces in dictionaries and tuples."""
    if isinstance(space, gym.spaces.Dict):
        return [leaf for inner in space.spaces.values() for leaf in nested_spaces(inner)]
    if isinstance(space, gym.spaces.Tuple):
        return [leaf for inner in space.spaces for leaf in nested_spaces(inner)]
    return [space]


def convert_action(indices: list[int], space: Any, config: dict[str, Any]) -> Any:
    """Convert action indices to an action of the environment's space; consumes the indices."""
    dimensions = sum(math.prod(one.shape) for one in nested_spaces(space) if is_box(one))
    m = config["action_bins"] or (11 if dimensions <= 2 else 7)

    def one(inner: Any) -> Any:
        if isinstance(inner, gym.spaces.Dict):
            return {key: one(part) for key, part in inner.spaces.items()}
        if isinstance(inner, gym.spaces.Tuple):
            return tuple(one(part) for part in inner.spaces)
        if isinstance(inner, gym.spaces.Discrete):
            return indices.pop(0) + inner.start
        mine = [indices.pop(0) for _ in range(math.prod(inner.shape))]
        if is_box(inner):
            low = np.where(np.isfinite(inner.low), inner.low, config["action_low"])
            high = np.where(np.isfinite(inner.high), inner.high, config["action_high"])
            bounds = zip(low.ravel().tolist(), high.ravel().tolist(), mine, strict=True)
            mine = [a + i * (b - a) / (m - 1) for a, b, i in bounds]
        array = np.array(mine).reshape(inner.shape)
        if isinstance(inner, gym.spaces.MultiDiscrete):
            array = array + inner.start
        return array.astype(inner.dtype)

    return one(space)


def run_episode(
    command: dict[str, Any], hello: dict[str, Any], network: Network | None
) -> dict[str, Any]:
    """Run a command; return the arrays and flags of its episode."""
    config, spec = hello["config"], hello["environment"]
    ns = components(spec)
    limited = {"max_episode_steps": command["max_steps"]} | config["environment_kwargs"]
    env = gym.make(config["environment"], **limited)
    u = numbers(command["stream_key"], command["max_steps"] * len(ns))
    begins = numbers(hashlib.sha256(command["stream_key"]).digest()[:16], command["max_steps"])
    begun = held_until = 0
    desired, horizon = command["desired_return"], float(command["desired_horizon"])
    observation, _ = env.reset(seed=command["environment_seed"])
    observations: list[list[npt.NDArray[Any]]] = []
    actions: list[list[int]] = []
    rewards: list[np.float32] = []
    state = np.zeros(network.state_size if network else 0, np.float32)
    terminated = truncated = False
    while not (terminated or truncated):
        if command["cap"] is not None:
            desired = min(desired, command["cap"])
        observations.append(convert_observation(observation, env.observation_space, spec))
        t = len(actions)
        since = t - command["random_from"]
        if command["random_rate"] and t >= held_until and begins[t] < command["random_rate"]:
            begun = t
            multiple = math.floor(1 / (1 - begins[t] / command["random_rate"]))
            held_until = t + command["random_hold"] * multiple
        row: list[float] = []
        if network is not None:
            stacked = stack_observations(observations, config["frame_stack"])
            found, state = network.logits(stacked, [desired, horizon], state)
            row = found.tolist()
        decides = t
        if t < held_until:
            decides, row = begun, []
        elif not command["random_rate"] and 0 <= since < command["random_steps"]:
            decides, row = t - since % command["random_hold"], []
        action, first = [], 0
        for i, n in enumerate(ns):
            number = u[decides * len(ns) + i]
            own = row[first : first + n]
            first += n
            action.append(choose(own, number, command["temperature"]) if own else int(number * n))
        actions.append(action)
        taken = convert_action(list(action), env.action_space, config)
        observation, reward, terminated, truncated, _ = env.step(taken)
        rewards.append(np.float32(reward))
        desired -= float(rewards[-1])
        horizon -= 1
    env.close()
    done = np.array(actions, "|u1" if max(ns) <= 256 else "<i4")
    return {
        "observations": encode_observations(observations, spec),
        "actions": done if spec["action_space"]["kind"] == "product" else done[:, 0],
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


def probe_rows(
    hello: dict[str, Any], state_size: int
) -> tuple[list[npt.NDArray[Any]], npt.NDArray[Any], npt.NDArray[Any]]:
    """Return the network inputs of 16 rows: observations by leaf, commands, states."""
    stack, sizes = hello["config"]["frame_stack"], []
    for _, space in leaves(hello["environment"]):
        names = ("size", "channels", "height", "width")
        first, *rest = [space[name] for name in names if name in space] or [
            len(space.get("ns", [1]))
        ]
        sizes.append((space["kind"], (16, stack * first, *rest)))
    total = sum(math.prod(shape) for _, shape in sizes)
    drawn = numbers(stream_key(0, "probe", 2, 0), total + 32 + 16 * state_size)
    shown = []
    for kind, shape in sizes:
        n = math.prod(shape)
        observed, drawn = drawn[:n], drawn[n:]
        if DTYPES[kind] == "|u1":
            observation = np.array([math.floor(u * 256) for u in observed], "|u1")
        elif DTYPES[kind] == "<i4":
            observation = np.zeros(n, "<i4")
        else:
            observation = np.array([u * 4 - 2 for u in observed], "<f4")
        shown.append(observation.reshape(shape))
    command = np.array([u * 200 - 100 for u in drawn[:32]], "<f8").reshape(16, 2)
    state = np.array([u * 2 - 1 for u in drawn[32:]], "<f4").reshape(16, state_size)
    return shown, command, state


def probe_logits(hello: dict[str, Any]) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    network = Network(hello["graph"], probe_weights(hello["graph"]))
    shown, command, state = probe_rows(hello, network.state_size)
    rows = [
        network.logits([leaf[k] for leaf in shown], command[k].tolist(), state[k])
        for k in range(16)
    ]
    logits, after = zip(*rows, strict=True)
    return np.array(logits, "<f4"), np.array(after, "<f4")


def numerics_class(hello: dict[str, Any]) -> str:
    logits, after = probe_logits(hello)
    ns = components(hello["environment"])
    drawn = numbers(stream_key(0, "probe", 3, 0), 64 * len(ns))
    actions = []
    for k in range(64):
        first, action = 0, []
        for i, n in enumerate(ns):
            own = logits[k % 16].tolist()[first : first + n]
            action.append(choose(own, drawn[k * len(ns) + i], 1.0))
            first += n
        actions.append(action)
    done = np.array(actions, "|u1" if max(ns) <= 256 else "<i4")
    is_product = hello["environment"]["action_space"]["kind"] == "product"
    arrays = {"actions": done if is_product else done[:, 0], "logits": logits}
    if after.size:
        arrays["next_state"] = after
    return arrays_digest(arrays).hex()[:16]


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


# The actor's main loop.


class Problem(Exception):
    """A problem reply; the argument is its code."""


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
    """Serve the only run on the router until it has ended; return the delivered episodes."""
    (reply,) = session.get("udrl/*/*/hello", payload=b"\x80", timeout=3.0)
    assert reply.ok is not None
    run = str(reply.ok.key_expr).removesuffix("/hello")
    assert run.startswith("udrl/5/")
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
