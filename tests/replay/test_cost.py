"""The cost of an iteration does not grow with the age of the run."""

from collections.abc import Callable

from tests.replay.synthetic import work
from udrl_replay.run import StoredRun

#: Tables of bounded size; the others keep a row for every iteration.
BOUNDED = {"facts", "commands", "episodes", "bodies", "CONSTANT"}
#: Indexes of the few rows that still have their blobs.
SMALL = ("weights_kept", "optimizers_kept")


def test_no_statement_scans_a_growing_table(make_run: Callable[..., StoredRun]) -> None:
    run = make_run(lead=1)
    for _ in range(5):
        work(run)
    statements: set[str] = set()
    run.store._db.set_trace_callback(statements.add)
    for _ in range(10):
        work(run)
    run.store.last_evaluation(is_final=False)
    run.store.last_evaluation(is_final=True)
    run.store.metrics(after=run.progress.iteration - 1)
    run.store._db.set_trace_callback(None)

    scans = []
    for statement in statements:
        if statement.startswith(("SELECT", "INSERT", "UPDATE", "DELETE")):
            for *_, step in run.store._db.execute(f"EXPLAIN QUERY PLAN {statement}"):
                verb, name = step.split()[:2]
                if verb == "SCAN" and name not in BOUNDED and not step.endswith(SMALL):
                    scans.append((step, statement))
    assert len(statements) > 20
    assert scans == []
