"""Key expressions: ``udrl/<protocol>/<run id>/<verb>``."""

import re

from udrl_proto import PROTOCOL

#: Queries to the replay service.
HELLO = "hello"
JOIN = "join"
COMMANDS = "commands"
EPISODE = "episode"
FAILURE = "failure"
CHANGES = "changes"
EPISODES = "episodes"
VERSION = "version"
STATE = "state"
WEIGHTS = "weights"
STATUS = "status"
HISTORY = "history"
CONTENTS = "contents"
VERBS = (
    HELLO,
    JOIN,
    COMMANDS,
    EPISODE,
    FAILURE,
    CHANGES,
    EPISODES,
    VERSION,
    STATE,
    WEIGHTS,
    STATUS,
    HISTORY,
    CONTENTS,
)

#: Publications; each may be lost, and nothing depends on one.
NEW_WEIGHTS = "news/weights"
PROGRESS = "news/progress"

RUN_ID = re.compile(r"[a-z0-9][a-z0-9-]{0,62}")


def key(run_id: str, verb: str) -> str:
    """Return the key of a verb or publication of a run."""
    return f"udrl/{PROTOCOL}/{run_id}/{verb}"


def alive(run_id: str, role: str, name: str) -> str:
    """Return the key of a liveliness token; ``*`` stands for any role or name."""
    return key(run_id, f"alive/{role}/{name}")


def every_hello() -> str:
    """Return the expression that finds every run on a router, whatever protocol it speaks."""
    return f"udrl/*/*/{HELLO}"


def parse(expression: str) -> tuple[str, str, str]:
    """Return protocol, run id and verb of a key; the verb may hold slashes.

    Raises:
        ValueError: the expression is not a key of ours.
    """
    parts = expression.split("/", 3)
    if len(parts) != 4 or parts[0] != "udrl":
        raise ValueError(f"key {expression!r}: expected udrl/<protocol>/<run id>/<verb>")
    return parts[1], parts[2], parts[3]
