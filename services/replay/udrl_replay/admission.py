"""Who may take part in a run: those who have its environment and compute its numbers."""

import msgspec

from udrl.errors import Refused
from udrl_proto.messages import JoinRequest
from udrl_replay.dealing import MOST_ACTORS
from udrl_replay.run import Run


def admit(run: Run, request: JoinRequest) -> None:
    """Let a service take part; the first of a role sets the run's numerics class for it.

    Raises:
        Refused: its environment or its numbers are others, it is shut out, or there are too many.
    """
    hello = run.hello
    if request.environment is not None and request.environment != hello.environment:
        raise Refused(
            "other_environment",
            f"the run's environment is {hello.environment}, yours is {request.environment}; "
            f"install the same version of the package that provides {hello.config.environment}",
        )
    if request.role == "actor":
        _compare_environments(run, request)
    _settle_numerics(run, request)
    if request.role == "actor":
        if request.id in run.quarantined:
            raise run.quarantined.refusal(request.id)
        if len(run.dealer.actors) >= MOST_ACTORS:
            raise Refused(
                "too_many_actors",
                f"{MOST_ACTORS} actors have joined, which is the most; give fewer actors more "
                f"environments (--envs)",
            )


def _compare_environments(run: Run, request: JoinRequest) -> None:
    """Compare what the environments do, where that is more than chance."""
    hello, found = run.hello, request.environment_digest
    if not hello.environment_digest or found == hello.environment_digest:
        return
    if not hello.allow_inexact:
        raise Refused(
            "other_environment",
            f"the environment {hello.config.environment} gives other observations or rewards "
            f"on {request.host} than where the run was created (a short episode has the digest "
            f"{found or 'of nothing'}, not {hello.environment_digest}); install the same version "
            f"of its package and of what it computes with, or create the run with --allow-inexact",
        )
    run.mark_inexact(f"the environment of actor {request.id} does something else")


def _settle_numerics(run: Run, request: JoinRequest) -> None:
    field = "acting_class" if request.role == "actor" else "training_class"
    known = getattr(run.hello, field)
    if not known:
        run.hello = msgspec.structs.replace(run.hello, **{field: request.numerics_class})
        run.store.set_fact("hello", run.hello)
    elif known != request.numerics_class:
        if not run.hello.allow_inexact:
            library = "onnxruntime" if request.role == "actor" else "torch"
            raise Refused(
                "other_numerics",
                f"the run's {request.role}s round like class {known}, this machine like "
                f"{request.numerics_class}, so results would depend on who computes them; use "
                f"a machine with the same kind of processor and the same versions of {library} "
                f"and numpy, or create the run with --allow-inexact",
            )
        run.mark_inexact(f"{request.role} {request.id} is of another numerics class")
