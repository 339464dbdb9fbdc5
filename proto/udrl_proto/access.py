"""Who may do what: one table, and the rules that a router makes of it.

A service proves its role with a certificate whose common name is that role
(:mod:`udrl_proto.credentials`). The router that the replay service hosts lets pass what stands
here, and drops everything else without an answer. The replay service itself has no row: it talks
within its own session, to which a router's rules do not apply. So nobody who connects can answer in
its place.
"""

from typing import Any, NamedTuple

from udrl_proto import keys


class Rights(NamedTuple):
    """What a role may do, besides what it does to itself.

    Attributes:
        asks: verbs that it may send to the replay service.
        hears: publications that it may receive.
        says: publications that it may send.
        joins: whether it may say with a liveliness token that it is here, and ask who else of its
            role is.
    """

    asks: tuple[str, ...]
    hears: tuple[str, ...] = ()
    says: tuple[str, ...] = ()
    joins: bool = False


#: The role that hosts the router; its certificate is the only one that a server may show.
REPLAY = "replay"

#: What those who connect may do, by role.
RIGHTS = {
    "learner": Rights(
        asks=(keys.HELLO, keys.JOIN, keys.CHANGES, keys.EPISODES, keys.VERSION, keys.STATE),
        hears=(keys.PROGRESS,),
        says=(keys.NEW_WEIGHTS,),
        joins=True,
    ),
    "actor": Rights(
        asks=(keys.HELLO, keys.JOIN, keys.COMMANDS, keys.EPISODE, keys.FAILURE, keys.WEIGHTS),
        hears=(keys.NEW_WEIGHTS,),
        joins=True,
    ),
    "observer": Rights(asks=(keys.HELLO, keys.STATUS, keys.WEIGHTS)),
}

#: Every role that there are certificates for.
ROLES = (REPLAY, *RIGHTS)


def access_control() -> dict[str, Any]:
    """Return Zenoh's ``access_control`` setting for a run's router."""
    rules = {role: _rules(role) for role in RIGHTS}
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule for of_role in rules.values() for rule in of_role],
        "subjects": [{"id": role, "cert_common_names": [role]} for role in RIGHTS],
        "policies": [
            {"subjects": [role], "rules": [rule["id"] for rule in of_role]}
            for role, of_role in rules.items()
        ],
    }


def _rules(role: str) -> list[dict[str, Any]]:
    """Return what the router lets in from a role, and what it lets out to it."""
    rights = RIGHTS[role]
    # A run is looked for whatever protocol it speaks, so that the difference can be told.
    asks = [keys.every_hello() if v == keys.HELLO else keys.key("*", v) for v in rights.asks]
    hears = [keys.key("*", name) for name in rights.hears]
    says = [keys.key("*", name) for name in rights.says]
    alive = [keys.alive("*", role, "*")] if rights.joins else []
    wanted = (
        ("asks", "ingress", "query", asks),
        ("is answered", "egress", "reply", asks),
        ("listens", "ingress", "declare_subscriber", hears),
        ("hears", "egress", "put", hears),
        ("says", "ingress", "put", says),
        ("is here", "ingress", "liveliness_token", alive),
        ("asks who is here", "ingress", "liveliness_query", alive),
        ("is told who is here", "egress", "liveliness_token", alive),
    )
    return [
        {
            "id": f"{role} {what}",
            "permission": "allow",
            "flows": [flow],
            "messages": [message],
            "key_exprs": expressions,
        }
        for what, flow, message, expressions in wanted
        if expressions
    ]
