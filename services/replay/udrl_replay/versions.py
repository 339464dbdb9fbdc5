"""Which weights versions a run takes in: the next one, once, with a finite loss."""

import math

from udrl.errors import Refused
from udrl_replay.run_state import RunState
from udrl_replay.store import Version


def is_known(run: RunState, version: Version) -> bool:
    """Say whether a version that was delivered is here already.

    Raises:
        Refused: it is another one of the same number, it diverged, or it is not the next.
    """
    number = version.version
    known = run.store.version(number)
    if known is not None:
        if known.digest != version.digest:
            raise Refused(
                "unequal_version",
                f"weights version {number} was delivered before with other values: "
                f"{known.digest.hex()[:16]}, now {version.digest.hex()[:16]}; the learner is "
                f"not deterministic, or belongs to another run",
            )
        return True
    if not math.isfinite(version.loss):
        raise Refused(
            "invalid",
            f"weights version {number} has the loss {version.loss}; training diverged, lower "
            f"learning_rate",
        )
    if number != run.awaits_version():
        raise Refused(
            "rewind",
            f"weights version {number} was delivered, {run.progress.latest_version + 1} is next; "
            f"ask for the state and go on there",
        )
    return False
