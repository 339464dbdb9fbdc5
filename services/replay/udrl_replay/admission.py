"""Admission of services: they need the run's environment and its numerics class.

The first actor whose episode is accepted sets the numerics class of the run's actors, the first
learner whose version is accepted that of its learners. Joining alone sets nothing, so a service
that never delivers excludes no other. A service must join before it delivers, since only then its
class is known.
"""

import msgspec

from udrl.errors import Refused
from udrl_proto.messages import JoinRequest, Role
from udrl_replay.dispatching import MOST_ACTORS
from udrl_replay.run import StoredRun

#: Maximum number of learners to remember; the one whose last join is oldest is forgotten first.
_MOST_LEARNERS = 1000


class Admission:
    """Admits services to a run or refuses them.

    Args:
        run: the run; its dispatcher knows the actors.
    """

    def __init__(self, run: StoredRun) -> None:
        self._run = run
        self._learners: dict[str, str] = {}  # numerics classes by name

    def join(self, request: JoinRequest, now: float) -> None:
        """Admit a service.

        Raises:
            Refused: its environment or numerics class differs from the run's, it is quarantined, or
                there are too many actors.
        """
        run, hello = self._run, self._run.hello
        if request.environment is not None and request.environment != hello.environment:
            raise Refused(
                "other_environment",
                f"the run's environment is {hello.environment}, yours is {request.environment}; "
                f"install the same version of the package that provides {hello.config.environment}",
            )
        if request.role == "actor":
            self._compare_environments(request)
        self._compare(request.role, request.numerics_class)
        if request.role == "learner":
            self._learners.pop(request.id, None)
            self._learners[request.id] = request.numerics_class
            if len(self._learners) > _MOST_LEARNERS:
                self.remove_service("learner", next(iter(self._learners)))
            return
        if request.id in run.quarantined:
            raise run.quarantined.refusal(request.id)
        actors = run.dispatcher.actors
        # An actor whose reply was lost joins again, and is already counted.
        if request.id not in actors and len(actors) >= MOST_ACTORS:
            raise Refused(
                "too_many_actors",
                f"{MOST_ACTORS} actors have joined, the maximum; use fewer actors with more "
                f"environments each (--envs)",
            )
        run.dispatcher.join(request, now)

    def check(self, role: Role, name: str) -> None:
        """Check that a service has joined, before it is given or delivers something.

        Raises:
            Refused: it has not joined, or another numerics class was set since it joined.
        """
        numerics_class = self._class_of(role, name)
        if numerics_class is None:
            raise Refused("join_first", f"{role} {name} has not joined; send join first")
        try:
            self._compare(role, numerics_class)
        except Refused:
            self.remove_service(role, name, vanished=False)
            raise

    def note_accepted(self, role: Role, name: str) -> None:
        """Note that a delivery was accepted from a service that was checked."""
        run, field = self._run, _CLASS_FIELDS[role]
        known, numerics_class = getattr(run.hello, field), self._class_of(role, name)
        if not known:
            run.hello = msgspec.structs.replace(run.hello, **{field: numerics_class})
            run.store.set_fact("hello", run.hello)
        elif known != numerics_class:
            run.mark_inexact(f"{role} {name} is of another numerics class")

    def remove_service(self, role: str, name: str, *, vanished: bool = True) -> None:
        """Remove a service that has vanished or was refused; its commands are assigned again."""
        if role == "actor":
            self._run.remove_actor(name, vanished=vanished)
        elif role == "learner":
            self._learners.pop(name, None)
            self._run.waits.end(f"learner {name}")

    def _class_of(self, role: Role, name: str) -> str | None:
        if role == "learner":
            return self._learners.get(name)
        actor = self._run.dispatcher.actors.get(name)
        return actor.join.numerics_class if actor else None

    def _compare_environments(self, request: JoinRequest) -> None:
        """Compare the behavior of the environments, if it is deterministic."""
        hello, found = self._run.hello, request.environment_digest
        if not hello.environment_digest or found == hello.environment_digest:
            return
        if not hello.allow_inexact:
            raise Refused(
                "other_environment",
                f"the environment {hello.config.environment} gives different observations or "
                f"rewards on {request.host} than where the run was created (digest of a short "
                f"episode: {found or 'none'}, expected {hello.environment_digest}); install the "
                f"same versions of its package and its dependencies, or create the run with "
                f"--allow-inexact",
            )
        self._run.mark_inexact(f"the environment of actor {request.id} behaves differently")

    def _compare(self, role: Role, numerics_class: str) -> None:
        """Refuse a service of another numerics class than the run's."""
        hello = self._run.hello
        known = getattr(hello, _CLASS_FIELDS[role])
        if known in ("", numerics_class) or hello.allow_inexact:
            return
        library = "onnxruntime" if role == "actor" else "torch"
        raise Refused(
            "other_numerics",
            f"the run's {role}s have numerics class {known}, this machine has {numerics_class}, so "
            f"results would depend on the machine; use one with the same kind of processor and the "
            f"same versions of {library} and numpy, or create the run with --allow-inexact",
        )


#: Field of the run specification with the numerics class of each role.
_CLASS_FIELDS: dict[Role, str] = {"actor": "acting_class", "learner": "training_class"}
