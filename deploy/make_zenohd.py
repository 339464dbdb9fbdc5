"""Writes ``deploy/zenohd.json5``, a router's configuration, from the table of who may do what.

::

    .venv/bin/python deploy/make_zenohd.py
"""

import json
from pathlib import Path

from udrl_proto.access import access_control
from udrl_proto.session import LEASE_MS, MAX_SESSIONS

FILE = Path(__file__).with_name("zenohd.json5")

_HEAD = """\
// zenohd --config deploy/zenohd.json5
//
// A router that carries runs, where the replay service connects to it like all others:
//   udrl replay ENV --connect tls/ROUTER:7447 --keys keys
// Its own keys are the folder keys/replay of `udrl keys create keys --host ROUTER`, as /etc/udrl,
// where the user that zenohd runs as must be able to read them.
//
// Written by deploy/make_zenohd.py.
"""


def text() -> str:
    """Return the configuration, as JSON below a comment."""
    keys = "/etc/udrl/"
    return (
        _HEAD
        + json.dumps(
            {
                "mode": "router",
                "listen": {"endpoints": ["tls/0.0.0.0:7447"]},
                "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
                "transport": {
                    "unicast": {"max_sessions": MAX_SESSIONS},
                    "shared_memory": {"enabled": False},
                    "link": {
                        "tx": {"lease": LEASE_MS},
                        "tls": {
                            "root_ca_certificate": f"{keys}ca.pem",
                            "listen_certificate": f"{keys}cert.pem",
                            "listen_private_key": f"{keys}key.pem",
                            "enable_mtls": True,
                            "close_link_on_expiration": True,
                        },
                    },
                },
                "access_control": access_control(hosted=False),
            },
            indent=2,
        )
        + "\n"
    )


if __name__ == "__main__":
    FILE.write_text(text(), encoding="utf-8")
