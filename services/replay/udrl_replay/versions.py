"""Which weights versions a run accepts: the next one, once, with a finite loss."""

import math

from udrl.errors import Refused
from udrl_replay.run_state import RunState
from udrl_replay.store import Version


def is_known(run: RunState, version: Version) -> bool:
    """Return whether a delivered version is already stored.

    Raises:
        Refused: it differs from the stored version, diverged, or is not the next version.
    """
    number = version.version
    known = run.store.version(number)
    if known is not None:
        if known.digest != version.digest:
            raise Refused(
                "unequal_version",
                f"weights version {number} has the digest {version.digest.hex()[:16]}, but was "
                f"delivered before with {known.digest.hex()[:16]}; the learner is not "
                f"deterministic, or belongs to another run",
            )
        return True
    if not math.isfinite(version.loss):
        raise Refused(
            "invalid",
            f"weights version {number} has the loss {version.loss}: training diverged; lower "
            f"learning_rate",
        )
    if number != run.awaits_version():
        raise Refused(
            "rewind",
            f"weights version {number} was delivered, {run.progress.latest_version + 1} is next; "
            f"request the state and continue from it",
        )
    return False
