"""The golden vectors match the code, and the code matches the description in the page."""

import hashlib
import json
import runpy
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from tests.proto import stranger
from tests.proto.strategies import MESSAGES
from udrl.acting import EpisodeGenerator, generate_episodes
from udrl.commands import Command
from udrl.config import Config
from udrl.environments import EnvironmentSpec
from udrl.frame_stack import Seen
from udrl.inference import Commands, Logits
from udrl.streams import Stream
from udrl_proto.codec import decode, encode
from udrl_proto.messages import Message

GOLDEN = Path(__file__).parents[2] / "proto" / "golden"
MAKE = runpy.run_path(str(GOLDEN / "make.py"))
EXAMPLES: tuple[Message, ...] = MAKE["EXAMPLES"]

each_example = pytest.mark.parametrize("message", EXAMPLES, ids=lambda m: type(m).__name__)
MASK = 2**64 - 1


def golden(message: Message) -> bytes:
    return bytes((GOLDEN / MAKE["file_name"](message)).read_bytes())


def test_every_message_type_has_one_example() -> None:
    assert sorted(type(m).__name__ for m in EXAMPLES) == [kind.__name__ for kind in MESSAGES]


@each_example
def test_encoding_gives_the_golden_bytes(message: Message) -> None:
    assert encode(message) == golden(message)


@each_example
def test_decoding_gives_the_golden_values(message: Message) -> None:
    assert decode(golden(message), type(message)) == message


@each_example
def test_fields_may_be_in_any_order(message: Message) -> None:
    fields = msgpack.unpackb(golden(message))
    backwards = dict(reversed(fields.items()))
    assert decode(msgpack.packb(backwards), type(message)) == message


def test_files_equal_the_generated_ones() -> None:
    written = {path.name: path.read_bytes() for path in GOLDEN.iterdir() if path.is_file()}
    del written["make.py"]
    expected = MAKE["contents"]()
    # Logits depend on the machine in their last bits.
    then, now = (json.loads(files.pop("probe.json")) for files in (written, expected))
    np.testing.assert_allclose(then.pop("logits"), now.pop("logits"), rtol=0, atol=1e-5)
    del then["class"], now["class"]
    assert then == now
    assert written == expected


# Arithmetic, with slow references that follow the page.


def philox(key: bytes, n: int) -> list[int]:
    """Return the first words of Philox4x64-10, counter from 1."""
    words: list[int] = []
    for counter in range(1, 1 + -(-n // 4)):
        block = [counter, 0, 0, 0]
        k0, k1 = int.from_bytes(key[:8], "little"), int.from_bytes(key[8:], "little")
        for _ in range(10):
            a, b = block[0] * 0xD2E7470EE14C6C93, block[2] * 0xCA5A826395121157
            block = [(b >> 64) ^ block[1] ^ k0, b & MASK, (a >> 64) ^ block[3] ^ k1, a & MASK]
            k0, k1 = (k0 + 0x9E3779B97F4A7C15) & MASK, (k1 + 0xBB67AE8584CAA73B) & MASK
        words += block
    return words[:n]


STREAMS: list[dict[str, Any]] = json.loads((GOLDEN / "streams.json").read_text())
CHOICES: list[dict[str, Any]] = json.loads((GOLDEN / "choices.json").read_text())
DIGESTS: dict[str, Any] = json.loads((GOLDEN / "digests.json").read_text())
PROBE: dict[str, Any] = json.loads((GOLDEN / "probe.json").read_text())


@pytest.mark.parametrize("vector", STREAMS, ids=lambda v: v["hashed"])
def test_stream_is_philox_with_a_hashed_key(vector: dict[str, Any]) -> None:
    key = hashlib.sha256(vector["hashed"].encode()).digest()[:16]
    words = philox(key, 9)
    assert key.hex() == vector["key"]
    assert [str(word) for word in words] == vector["words"]
    assert [(word >> 11) * 2.0**-53 for word in words] == vector["numbers"]
    assert Stream(key).uniforms(9).tolist() == vector["numbers"]


def test_probe_follows_the_page() -> None:
    hello = msgpack.unpackb((GOLDEN / "hello.msgpack").read_bytes())
    weights = stranger.probe_weights(hello["graph"])
    assert stranger.arrays_digest(weights).hex() == PROBE["weights"]
    (observation,), command, _ = stranger.probe_rows(hello, 0)
    rows = {"command": command, "observation": observation}
    assert stranger.arrays_digest(rows).hex() == PROBE["rows"]
    logits, _ = stranger.probe_logits(hello)
    assert logits.tolist() == MAKE["probe"]()["logits"]
    np.testing.assert_allclose(logits, PROBE["logits"], rtol=0, atol=1e-5)


def test_numerics_class_is_the_digest_of_logits_and_actions() -> None:
    arrays = {
        "logits": np.array(PROBE["logits"], "<f4"),
        "actions": np.array(PROBE["actions"], "|u1"),
    }
    assert stranger.arrays_digest(arrays).hex()[:16] == PROBE["class"]


def test_episode_digest_follows_the_page() -> None:
    arrays = {n: np.array(a["values"], a["dtype"]) for n, a in DIGESTS["arrays"].items()}
    assert stranger.arrays_digest(arrays).hex() == DIGESTS["arrays_digest"]
    episode = arrays | {n: DIGESTS[n] for n in ("terminated", "truncated")}
    assert stranger.episode_digest(DIGESTS["id"], episode).hex() == DIGESTS["digest"]


def test_probe_logits_are_stored_exactly() -> None:
    logits = np.array(PROBE["logits"])
    assert logits.shape == (16, 2)
    assert np.array_equal(logits, logits.astype(np.float32))


class Fixed:
    """An acting graph with constant logits."""

    def __init__(self, logits: list[float], spec: EnvironmentSpec) -> None:
        self._logits = np.array([logits], np.float32)
        # The only observation that is stacked.
        shape, dtype = spec.observation_space.shape or (1,), spec.observation_space.dtype
        self.seen: Seen = (np.zeros((1, *shape), dtype),)
        self.state = self.next_state = np.zeros((1, 0), np.float32)
        self.command: Commands = np.zeros((1, 2))
        self.logits: Logits = np.zeros_like(self._logits)

    def call(self, n: int) -> "Fixed":
        assert n == 1
        return self

    def run(self) -> None:
        self.logits[:] = self._logits


@pytest.mark.parametrize(("temperature", "key"), [(1.0, "action"), (0.5, "half"), (0.0, "mode")])
@pytest.mark.parametrize("vector", CHOICES, ids=lambda v: f"{v['logits']}-{v['u']:.3f}")
def test_actor_chooses_the_actions_of_the_vectors(
    vector: dict[str, Any], temperature: float, key: str
) -> None:
    generator = EpisodeGenerator(Config(environment="Figure2-v0"), 1)
    command = Command(
        id=0,
        kind="evaluate",
        desired_return=0.0,
        desired_horizon=1,
        environment_seed=1,
        stream_key=bytes.fromhex(vector["key"]),
        weights_version=1,
        max_steps=2,
        temperature=temperature,
    )
    (episode,) = generate_episodes(generator, [command], Fixed(vector["logits"], generator.spec))
    assert episode.actions[0] == vector[key]
    generator.close()
