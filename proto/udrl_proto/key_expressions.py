"""Key expressions: ``udrl/<protocol>/<run id>/<verb>``."""

import re

from udrl_proto import PROTOCOL

#: Publications. Each may be lost; none is relied on.
NEW_WEIGHTS = "news/weights"
PROGRESS = "news/progress"

RUN_ID = re.compile(r"[a-z0-9][a-z0-9-]{0,62}")


def key(run_id: str, verb: str) -> str:
    """Return the key of a verb or publication of a run."""
    return f"udrl/{PROTOCOL}/{run_id}/{verb}"


def alive(run_id: str, role: str, name: str) -> str:
    """Return the key of a liveliness token; ``*`` matches any role or name."""
    return key(run_id, f"alive/{role}/{name}")


def every_hello() -> str:
    """Return the expression that finds every run on a router, of any protocol version."""
    return "udrl/*/*/hello"


def parse(expression: str) -> tuple[str, str, str]:
    """Return protocol, run id and verb of a key; the verb may contain slashes.

    Raises:
        ValueError: the expression is not one of udrl's keys.
    """
    parts = expression.split("/", 3)
    if len(parts) != 4 or parts[0] != "udrl":
        raise ValueError(f"key {expression!r}: expected udrl/<protocol>/<run id>/<verb>")
    return parts[1], parts[2], parts[3]
