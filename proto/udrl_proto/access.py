"""Who may do what: one table, and the rules that a router makes of it.

A service proves its role with a certificate whose common name is that role
(:mod:`udrl_proto.credentials`). The router that the replay service hosts lets pass what stands
here, and drops everything else without an answer. The replay service itself has no row: it talks
within its own session, to which a router's rules do not apply. So nobody who connects can answer in
its place. To a router that somebody else hosts it connects like the others, and there it may answer
what they ask.
"""

from typing import Any, NamedTuple

from udrl_proto import key_expressions, verbs


class Rights(NamedTuple):
    """What a role may do besides asking (:mod:`udrl_proto.verbs`).

    Attributes:
        hears: publications that it may receive.
        says: publications that it may send.
        joins: whether it may say with a liveliness token that it is here, and ask who else of its
            role is.
    """

    hears: tuple[str, ...] = ()
    says: tuple[str, ...] = ()
    joins: bool = False


#: The role that hosts the router; its certificate is the only one that a server may show.
REPLAY = "replay"

#: What those who connect may do, by role.
RIGHTS = {
    "learner": Rights(
        hears=(key_expressions.PROGRESS,),
        says=(key_expressions.NEW_WEIGHTS,),
        joins=True,
    ),
    "actor": Rights(
        hears=(key_expressions.NEW_WEIGHTS,),
        joins=True,
    ),
    "observer": Rights(),
}

#: Every role that there are certificates for.
ROLES = (REPLAY, *RIGHTS)


#: What passes a router: what it is for, the flow, and the kind of message, as Zenoh calls them.
Rule = tuple[str, str, str]


def access_control(*, hosted: bool = True) -> dict[str, Any]:
    """Return Zenoh's ``access_control`` setting for a run's router.

    Args:
        hosted: the replay service hosts it; otherwise it connects to it.
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


def _question(verb: str) -> str:
    # A run is looked for whatever protocol it speaks, so that the difference can be told.
    return (
        key_expressions.every_hello()
        if verb == verbs.HELLO.name
        else key_expressions.key("*", verb)
    )


def _of_client(role: str) -> dict[Rule, list[str]]:
    """Return what the router lets in from a role, and what it lets out to it."""
    rights = RIGHTS[role]
    asks = [_question(verb) for verb in verbs.asked_by(role)]
    hears = [key_expressions.key("*", name) for name in rights.hears]
    says = [key_expressions.key("*", name) for name in rights.says]
    alive = [key_expressions.alive("*", role, "*")] if rights.joins else []
    return {
        ("asks", "ingress", "query"): asks,
        ("is answered", "egress", "reply"): asks,
        ("listens", "ingress", "declare_subscriber"): hears,
        ("hears", "egress", "put"): hears,
        ("says", "ingress", "put"): says,
        ("is here", "ingress", "liveliness_token"): alive,
        ("asks who is here", "ingress", "liveliness_query"): alive,
        ("is told who is here", "egress", "liveliness_token"): alive,
    }


def _of_replay() -> dict[Rule, list[str]]:
    """Return the counterpart: what a router lets in from the replay service, and out to it."""
    answers = [_question(verb.name) for verb in verbs.VERBS]
    says = [key_expressions.key("*", key_expressions.PROGRESS)]
    alive = [
        key_expressions.alive("*", role, "*") for role, rights in RIGHTS.items() if rights.joins
    ]
    watches = [key_expressions.alive("*", "*", "*")]
    return {
        ("offers answers", "ingress", "declare_queryable"): answers,
        ("is asked", "egress", "query"): answers,
        ("answers", "ingress", "reply"): answers,
        ("says", "ingress", "put"): says,
        ("watches", "ingress", "declare_liveliness_subscriber"): watches,
        ("is told who is here", "egress", "liveliness_token"): alive,
    }
