"""Write the golden vectors: ``python proto/golden/make.py``.

Every message type has one example here. Its bytes are in ``<name>.msgpack`` and its values in
``README.md``; ``streams.json``, ``choices.json``, ``digests.json`` and ``probe.json`` are test
vectors for an actor's arithmetic.
"""

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from udrl.actions import Categorical
from udrl.commands import Command
from udrl.config import Config, build, flat
from udrl.digests import arrays_digest, episode_digest
from udrl.environments import EnvironmentSpec
from udrl.episode import Episode
from udrl.graph import acting_graph
from udrl.inference import ActingFunction, probe_rows, probe_weights
from udrl.numerics import PROBE_ROWS
from udrl.spaces import Vector
from udrl.streams import Purpose, Stream, stream_key
from udrl_proto import PROTOCOL
from udrl_proto.codec import decode, encode, encode_array, encode_episode
from udrl_proto.messages import (
    Acknowledged,
    ChangesReply,
    ChangesRequest,
    CommandsReply,
    CommandsRequest,
    EpisodeMessage,
    EpisodeReply,
    EpisodesReply,
    EpisodesRequest,
    FailureMessage,
    Hello,
    HelloRequest,
    JoinReply,
    JoinRequest,
    Message,
    Problem,
    Progress,
    StateReply,
    StateRequest,
    VersionMessage,
    VersionReply,
    Wait,
    WeightsMessage,
    WeightsRequest,
)
from udrl_proto.reports import (
    ActorStatus,
    AuditStatus,
    BufferStatus,
    CommandLedger,
    Contents,
    ContentsRequest,
    EpisodeLedger,
    EvaluationStatus,
    History,
    HistoryRequest,
    IterationStatus,
    Quarantined,
    Status,
    StatusRequest,
    Waiting,
)

FOLDER = Path(__file__).parent

CONFIG = build(
    Config,
    {
        "environment": "CartPole-v1",
        "environment_kwargs": {"sutton_barto_reward": False},
        "max_return": 500.0,
        "seed": 7,
        "lead": 1,
        "batch_size": 256,
        "horizon_scale": 0.02,
        "last_few": 50,
        "learning_rate": 0.001,
        "n_episodes_per_iter": 15,
        "n_updates_per_iter": 100,
        "n_warm_up_episodes": 30,
        "warm_up_hold_steps": 5,
        "replay_size": 300,
        "max_age": 50,
        "recent_size": 100,
        "return_scale": 0.02,
        "hidden": [32, 64, 64],
        "eval_every": 20_000,
    },
)
ENVIRONMENT = EnvironmentSpec(
    observation_space=Vector(size=4),
    action_space=Categorical(n=2),
    max_episode_steps=500,
    max_return=500.0,
)
GRAPH = acting_graph(CONFIG.network, ENVIRONMENT)
EPISODE = Episode(
    command_id=5_000_003,
    observations=np.array(
        [[0.0, 0.5, -0.25, 1.0], [0.125, -1.5, 0.75, -0.0], [3.0, 1e-3, -2.5, 0.1]], np.float32
    ),
    actions=np.array([1, 0, 1], np.uint8),
    rewards=np.array([1.0, 1.0, -0.5], np.float32),
    terminated=True,
    truncated=False,
)
COMMAND = Command(
    id=5_000_003,
    kind="explore",
    desired_return=212.40625,
    desired_horizon=198,
    environment_seed=4_321_987,
    stream_key=stream_key(7, Purpose.EPISODE, 5, 3),
    weights_version=4,
    max_steps=500,
)
EVALUATION = EvaluationStatus(
    iteration=4,
    env_steps=20_113,
    mean=187.25,
    std=12.5,
    ci95_low=184.8,
    ci95_high=189.7,
    episodes=100,
)
COMMANDS = CommandLedger(issued=120, accepted=100, cancelled=0, outstanding=20)
EPISODES = EpisodeLedger(delivered=103, accepted=100, duplicate=2, rejected=1)
ITERATION = IterationStatus(
    iteration=5,
    commands=20,
    env_steps=24_120,
    eval_env_steps=30_500,
    wall_s=6.125,
    weights_version=4,
    loss=0.6875,
    return_min=21.0,
    return_mean=95.5,
    return_max=500.0,
    explored_return=88.25,
    commanded_min=290.5,
    commanded_max=480.75,
    admitted=12,
)
BUFFER = BufferStatus(episodes=90, return_min=21.0, return_mean=95.5, return_max=500.0)
ACTOR = ActorStatus(
    id="actor-1",
    host="node7",
    environments=16,
    env_steps_per_s=9120.5,
    weights_version=4,
    weights_lag=1,
    running=12,
    reruns=2,
    failures=1,
    last_seen_s=0.125,
)
AUDIT = AuditStatus(rate=0.125, agreed=11, open=2, disputed=0)
QUARANTINED = Quarantined(
    id="actor-9",
    why="its episode of command 5000003 differs from that of two others",
)
WAITING = Waiting(who="actor actor-1", on="learner", why="weights version 6", seconds=0.25)

#: One example of every message type.
EXAMPLES: tuple[Message, ...] = (
    encode_array(np.arange(6, dtype=np.int32).reshape(2, 3)),
    Wait(on="learner: weights version 6", retry_after_s=0.28125),
    Problem(code="rewind", message="version 6 is next, not 5; request the state"),
    HelloRequest(),
    Hello(
        protocol=PROTOCOL,
        software="0.1.0",
        run_id="cartpole-v1-seed7-20260102-030405-678901",
        settings=flat(CONFIG),
        environment=ENVIRONMENT,
        graph=GRAPH,
        acting_class="0123456789abcdef",
    ),
    JoinRequest(
        role="actor",
        id="actor-1",
        host="node7",
        pid=4242,
        software="0.1.0",
        environments=16,
        numerics_class="0123456789abcdef",
        environment=ENVIRONMENT,
    ),
    JoinReply(),
    CommandsRequest(
        actor="actor-1",
        wanted=4,
        running=(5_000_001, 5_000_007),
        spare_cores=1.5,
        env_steps_per_s=9120.5,
        weights_version=4,
    ),
    CommandsReply(commands=(COMMAND,)),
    decode(encode_episode(EPISODE, "actor-1"), EpisodeMessage),
    EpisodeReply(result="accepted"),
    FailureMessage(
        actor="actor-1",
        command_id=5_000_003,
        error="the environment failed in step() under command 5000003 (seed 4321987): no fuel",
    ),
    Acknowledged(),
    ChangesRequest(learner="learner-1", version=6),
    ChangesReply(ids=(5_000_003, 29, 4_000_000)),
    EpisodesRequest(ids=(5_000_003, 29)),
    EpisodesReply(episodes=(encode_episode(EPISODE, "actor-1"),)),
    VersionMessage(
        learner="learner-1",
        version=6,
        weights=b"safetensors of the weights",
        optimizer=b"safetensors of Adam's state",
        loss=0.6875,
        train_s=0.25,
    ),
    VersionReply(result="duplicate"),
    StateRequest(learner="learner-1"),
    StateReply(version=5, weights=b"safetensors", optimizer=b"safetensors"),
    WeightsRequest(version="latest"),
    WeightsMessage(version=5, weights=b"safetensors"),
    Progress(iteration=5),
    StatusRequest(),
    COMMANDS,
    EPISODES,
    BUFFER,
    ACTOR,
    WAITING,
    EVALUATION,
    AUDIT,
    QUARANTINED,
    Status(
        run_id="cartpole-v1-seed7-20260102-030405-678901",
        state="running",
        environment="CartPole-v1",
        iteration=5,
        env_steps=24_120,
        eval_env_steps=18_725,
        env_steps_per_s=9120.5,
        wall_s=6.125,
        max_env_steps=200_000,
        stop_return=475.0,
        time_left_s=44.5,
        commands=COMMANDS,
        episodes=EPISODES,
        buffer=BUFFER,
        weights_version=5,
        weights_lag=1,
        weights_lag_s=0.0125,
        weights_sha256="ab" * 32,
        replay_sha256="cd" * 32,
        weights_kept=(2, 4, 5),
        loss=0.6875,
        evaluation=EVALUATION,
        final_evaluation=None,
        exact=True,
        inexact_reason="",
        useful_concurrency=30,
        env_failures=0,
        actors=(ACTOR,),
        waiting=(WAITING,),
        problem="",
        deceived=False,
        ended_because="",
        limit_reached=None,
        advice="",
        audit=AUDIT,
        quarantined=(QUARANTINED,),
    ),
    HistoryRequest(after=-1),
    ITERATION,
    History(iterations=(ITERATION,), evaluations=(EVALUATION,), more=False),
    ContentsRequest(),
    Contents(
        iteration=5,
        returns=(21.0, 95.5, 500.0),
        lengths=(21, 96, 500),
        iterations=(0, 3, 5),
        desired_return=297.75,
        desired_horizon=298,
        return_std=202.25,
        desired_returns=(297.75, 450.5),
        desired_horizons=(298, 298),
        versions=(4, 5),
    ),
)

_STREAMS = (
    (7, Purpose.EPISODE, 5, 3),
    (7, Purpose.COMMANDS, 5, -1),
    (0, Purpose.PROBE, 2, 0),
    (2**63 - 1, Purpose.TRAINING, 1, 0),
)
_LOGITS = ((0.0, 0.0, 0.0), (1.5, -0.25, 0.125), (-100.0, 0.0, 100.0), (2.0, 2.0, 1.0))

_INTRODUCTION = """\
# Golden vectors

Bytes to test a codec and an actor's arithmetic with; [the protocol](../README.md) says what they
mean. All files here are written by `make.py` and checked by the tests.

- `<name>.msgpack` holds one message, and the same name below has its values: as JSON, with bytes as
  `hex:...`. An encoder must give values that decode to these; the order of fields and the width of
  numbers are free, but ours are in the order shown, with the shortest form of every integer.
- `streams.json` holds random streams: what the key is made from, the key, the first 64-bit words of
  Philox4x64-10 and the numbers that are made of them.
- `choices.json` holds choices of the first action of an episode: the key of its stream, the first
  number u of that, float32 logits, and the action; `half` and `mode` are the actions
  at the temperatures 0.5 and 0, `action` that at 1.
- `probe.json` holds the [probe](../README.md#numerics-class), with the graph of
  `hello.msgpack`: the digest of its weights, the digest of its rows as the arrays `command` (`<f8`)
  and `observation`, the logits of each row, the 64 actions, and the class. The decimals are exact:
  read as float32 they give the bits. Another kind of processor or version of ONNX Runtime may
  differ from them in the last bits, and is then of another numerics class. A difference above
  0.00001 is a mistake.
- `digests.json` holds an episode of two steps, as numbers with the dtype of each array, with the
  digest of its arrays and its own.

"""


def file_name(message: Message) -> str:
    """Return the file of a message: ``CommandsRequest`` is in ``commands-request.msgpack``."""
    words = re.findall(r"[A-Z][a-z]*", type(message).__name__)
    return "-".join(words).lower() + ".msgpack"


def as_json(value: Any) -> str:
    """Return plain values as JSON, with bytes as ``hex:...``."""
    text: str = json.dumps(value, indent=1, default=lambda data: f"hex:{data.hex()}")
    return text


def streams() -> list[dict[str, Any]]:
    """Return the first numbers of some random streams; words are text, since they have 64 bits."""
    found = []
    for address in _STREAMS:
        key = stream_key(*address)
        words = np.random.Philox(key=int.from_bytes(key, "little")).random_raw(9)
        found.append(
            {
                "hashed": "udrl/stream/1|" + "|".join(map(str, address)),
                "key": key.hex(),
                "words": [str(word) for word in words],
                "numbers": Stream(key).uniforms(9).tolist(),
            }
        )
    return found


def choices() -> list[dict[str, Any]]:
    """Return the first actions of some episodes, chosen one by one as the protocol says."""
    found = []
    for logits in _LOGITS:
        for index in range(5):
            key = stream_key(7, Purpose.EPISODE, 5, index)
            (u,) = Stream(key).uniforms(1).tolist()
            found.append(
                {
                    "key": key.hex(),
                    "u": u,
                    "logits": list(logits),
                    "action": choose(logits, u),
                    "half": choose(tuple(2 * x for x in logits), u),
                    "mode": logits.index(max(logits)),
                }
            )
    return found


def choose(logits: Sequence[float], u: float) -> int:
    """Return the action for logits and a number of the stream."""
    total = 0.0
    cumulative = [total := total + math.exp(x - max(logits)) for x in logits]
    return min(sum(c <= u * total for c in cumulative), len(logits) - 1)


def probe() -> dict[str, Any]:
    """Return the probe of the graph: digests of its weights and rows, and the logits."""
    weights = probe_weights(GRAPH)
    function = ActingFunction(GRAPH, weights)
    seen, command, _ = probe_rows(function, PROBE_ROWS)
    logits = function.logits(seen, command)
    actions = [
        choose(logits[k % PROBE_ROWS].tolist(), u)
        for k, u in enumerate(Stream(stream_key(0, Purpose.PROBE, 3, 0)).uniforms(64).tolist())
    ]
    arrays: dict[str, npt.NDArray[Any]] = {
        "actions": np.array(actions, np.uint8),
        "logits": logits,
    }
    return {
        "weights": arrays_digest(weights).hex(),
        "rows": arrays_digest({"command": command, "observation": seen[0]}).hex(),
        "logits": logits.tolist(),
        "actions": actions,
        "class": arrays_digest(arrays).hex()[:16],
    }


def digests() -> dict[str, Any]:
    """Return an episode and its digests."""
    episode = Episode(
        command_id=3_000_007,
        observations=np.array([[0.5, -1.25], [3.0, 0.0]], np.float32),
        actions=np.array([2, 0], np.uint8),
        rewards=np.array([-1.0, 0.25], np.float32),
        terminated=True,
        truncated=False,
    )
    names = "actions", "observations", "rewards"
    arrays: dict[str, npt.NDArray[Any]] = {name: getattr(episode, name) for name in names}
    return {
        "id": episode.command_id,
        "terminated": episode.terminated,
        "truncated": episode.truncated,
        "arrays": {n: {"dtype": a.dtype.str, "values": a.tolist()} for n, a in arrays.items()},
        "arrays_digest": arrays_digest(arrays).hex(),
        "digest": episode_digest(episode).hex(),
    }


def contents() -> dict[str, bytes]:
    """Return every golden file by its name."""
    files = {file_name(message): encode(message) for message in EXAMPLES}
    readme = _INTRODUCTION
    for message in EXAMPLES:
        plain = msgspec.to_builtins(message, builtin_types=(bytes,))
        readme += f"## `{file_name(message)}`: {type(message).__name__}\n\n"
        readme += f"```json\n{as_json(plain)}\n```\n\n"
    files["README.md"] = (readme.rstrip() + "\n").encode()
    files["streams.json"] = (as_json(streams()) + "\n").encode()
    files["choices.json"] = (as_json(choices()) + "\n").encode()
    files["digests.json"] = (as_json(digests()) + "\n").encode()
    files["probe.json"] = (as_json(probe()) + "\n").encode()
    return files


if __name__ == "__main__":
    for name, content in contents().items():
        (FOLDER / name).write_bytes(content)
