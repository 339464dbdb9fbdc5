"""The permissions of each role, and the access rules of a router that enforce them.

A service proves its role with a certificate whose common name is that role
(:mod:`udrl_proto.credentials`). The router hosted by the replay service forwards what is allowed
here and silently drops everything else. The replay service itself has no row: it uses its own
session, to which a router's rules do not apply, so no client can reply in its place. It connects to
a separate router like any client, and may reply to requests there.
"""

from typing import Any, NamedTuple

from udrl_proto import key_expressions, verbs


class Rights(NamedTuple):
    """What a role may do besides sending requests (:mod:`udrl_proto.verbs`).

    Attributes:
        subscribes: publications that it may receive.
        publishes: publications that it may send.
        joins: whether it may declare a liveliness token and query those of its own role.
    """

    subscribes: tuple[str, ...] = ()
    publishes: tuple[str, ...] = ()
    joins: bool = False


#: The role that hosts the router; only its certificate is issued for servers.
REPLAY = "replay"

#: Permissions of the clients, by role.
RIGHTS = {
    "learner": Rights(
        subscribes=(key_expressions.PROGRESS,),
        publishes=(key_expressions.NEW_WEIGHTS,),
        joins=True,
    ),
    "actor": Rights(
        subscribes=(key_expressions.NEW_WEIGHTS,),
        joins=True,
    ),
    "observer": Rights(),
}

#: All roles for which certificates are issued.
ROLES = (REPLAY, *RIGHTS)


#: A rule of a router: its purpose, then Zenoh's names of the flow and the kind of message.
Rule = tuple[str, str, str]


def access_control(*, hosted: bool = True) -> dict[str, Any]:
    """Return Zenoh's ``access_control`` setting for a run's router.

    Args:
        hosted: whether the replay service hosts the router, rather than connecting to it.
    """
    wanted = {role: _of_client(role) for role in RIGHTS}
    if not hosted:
        wanted[REPLAY] = _of_replay()
    rules = {
        role: [
            {
                "id": f"{role} {what}",
                "permission": "allow",
                "flows": [flow],
                "messages": [message],
                "key_exprs": expressions,
            }
            for (what, flow, message), expressions in of_role.items()
            if expressions
        ]
        for role, of_role in wanted.items()
    }
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule for of_role in rules.values() for rule in of_role],
        "subjects": [{"id": role, "cert_common_names": [role]} for role in rules],
        "policies": [
            {"subjects": [role], "rules": [rule["id"] for rule in of_role]}
            for role, of_role in rules.items()
        ],
    }


def _request(verb: str) -> str:
    # Runs of any protocol version can be found, so that a mismatch can be reported.
    return (
        key_expressions.every_hello()
        if verb == verbs.HELLO.name
        else key_expressions.key("*", verb)
    )


def _of_client(role: str) -> dict[Rule, list[str]]:
    """Return the messages that the router accepts from a role and forwards to it."""
    rights = RIGHTS[role]
    requests = [_request(verb) for verb in verbs.sent_by(role)]
    subscriptions = [key_expressions.key("*", name) for name in rights.subscribes]
    publications = [key_expressions.key("*", name) for name in rights.publishes]
    alive = [key_expressions.alive("*", role, "*")] if rights.joins else []
    return {
        ("sends requests", "ingress", "query"): requests,
        ("receives replies", "egress", "reply"): requests,
        ("subscribes", "ingress", "declare_subscriber"): subscriptions,
        ("receives publications", "egress", "put"): subscriptions,
        ("publishes", "ingress", "put"): publications,
        ("declares presence", "ingress", "liveliness_token"): alive,
        ("queries presence", "ingress", "liveliness_query"): alive,
        ("receives presence", "egress", "liveliness_token"): alive,
    }


def _of_replay() -> dict[Rule, list[str]]:
    """Return the messages that a router accepts from the replay service and forwards to it."""
    requests = [_request(verb.name) for verb in verbs.VERBS]
    publications = [key_expressions.key("*", key_expressions.PROGRESS)]
    alive = [
        key_expressions.alive("*", role, "*") for role, rights in RIGHTS.items() if rights.joins
    ]
    watched = [key_expressions.alive("*", "*", "*")]
    return {
        ("declares queryables", "ingress", "declare_queryable"): requests,
        ("receives requests", "egress", "query"): requests,
        ("sends replies", "ingress", "reply"): requests,
        ("publishes", "ingress", "put"): publications,
        ("watches presence", "ingress", "declare_liveliness_subscriber"): watched,
        ("receives presence", "egress", "liveliness_token"): alive,
    }
