"""Fuzz every decoder and every queryable.

::

    .venv/bin/python -m pip install --editable '.[fuzz]'
    .venv/bin/python -m tests.fuzz coverage --inputs 1000000
    .venv/bin/python -m tests.fuzz hypothesis --inputs 1000000

``coverage`` mutates valid requests, guided by the branches of our code that they reach;
``hypothesis`` draws messages from the types of the protocol. Either ends with an error at the
first input that raises, hangs for five seconds, takes more than a gigabyte, unbalances a ledger,
or is accepted though invalid. Otherwise it prints the numbers of accepted and refused inputs.
"""

import argparse
import logging
import resource
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

_MOST_MIB = 1024
#: Hypothesis keeps more than a kilobyte for each example; hence it is restarted.
_ROUND = 20_000


def main() -> None:
    """Parse the command line and fuzz."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("engine", choices=("coverage", "hypothesis"))
    parser.add_argument("--inputs", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    logging.getLogger("udrl").setLevel(logging.CRITICAL)
    began = time.monotonic()
    if options.engine == "coverage":
        by_coverage(options.inputs, options.seed)
    else:
        by_type(options.inputs, options.seed)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{time.monotonic() - began:,.0f} s, at most {memory:,.0f} MiB", flush=True)
    if memory > _MOST_MIB:
        raise SystemExit(f"more than {_MOST_MIB} MiB of memory")


def by_coverage(inputs: int, seed: int) -> None:
    """Let libFuzzer mutate inputs; it ends the process at the first failure."""
    import atheris

    with atheris.instrument_imports(include=["udrl", "udrl_proto", "udrl_replay"]):
        from tests.fuzz.world import Target, decode_as_every_message, valid_requests

    target = Target(valid_requests())

    def one(data: bytes) -> None:
        target(data)
        decode_as_every_message(data[1:])
        if target.accepted + target.refused == inputs:  # libFuzzer exits by itself
            print(f"{target.accepted:,} answered, {target.refused:,} refused", flush=True)

    with TemporaryDirectory() as corpus:
        for number, data in enumerate(target.seeds()):
            (Path(corpus) / str(number)).write_bytes(data)
        atheris.Setup(
            [sys.argv[0], f"-runs={inputs}", f"-seed={seed}", "-timeout=5",
             f"-rss_limit_mb={_MOST_MIB}", "-max_len=8192", "-print_final_stats=1", corpus],
            one,
        )  # fmt: skip
        atheris.Fuzz()


def by_type(inputs: int, seed: int) -> None:
    """Draw messages of every type with values of every kind."""
    import hypothesis
    from hypothesis import strategies as st

    from tests.fuzz.world import (
        BY_NAME,
        NAMES,
        Target,
        decode_as_every_message,
        valid_requests,
    )
    from tests.proto.strategies import messages
    from udrl_proto.codec import encode

    target = Target(valid_requests())
    drawn = st.sampled_from(NAMES).flatmap(
        lambda verb: messages(BY_NAME[verb].request).map(
            lambda message: bytes([NAMES.index(verb)]) + encode(message)
        )
    )
    known = st.sampled_from(target.seeds())
    changed = st.tuples(known, st.integers(0, 8191), st.binary(max_size=12)).map(
        lambda given: given[0][: given[1]] + given[2] + given[0][given[1] + len(given[2]) :]
    )

    def send(data: bytes) -> None:
        target(data)
        decode_as_every_message(data[1:])

    for done in range(0, inputs, _ROUND):
        rounds = hypothesis.settings(
            max_examples=min(_ROUND, inputs - done), deadline=5000, database=None,
            phases=[hypothesis.Phase.generate],
            suppress_health_check=list(hypothesis.HealthCheck),
        )  # fmt: skip
        hypothesis.seed(seed + done)(rounds(hypothesis.given(drawn | changed)(send)))()
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(
            f"{target.accepted:,} answered, {target.refused:,} refused, {memory:,.0f} MiB",
            flush=True,
        )


if __name__ == "__main__":
    main()
