"""Who may take part in a run."""

from collections.abc import Callable

import pytest
from msgspec.structs import replace

from tests.replay.synthetic import SPEC, join
from udrl.errors import Refused
from udrl_proto.messages import Hello
from udrl_replay import admission
from udrl_replay.admission import admit
from udrl_replay.run import Run


def test_first_actor_and_first_learner_set_the_numerics_classes(
    make_run: Callable[..., Run],
) -> None:
    run = make_run()
    admit(run, replace(join("a"), numerics_class="of actors"))
    admit(run, replace(join("l"), role="learner", numerics_class="of learners", environment=None))
    assert (run.hello.acting_class, run.hello.training_class) == ("of actors", "of learners")
    assert run.store.fact("hello", Hello) == run.hello


def test_another_numerics_class_is_refused_unless_the_run_allows_it(
    make_run: Callable[..., Run],
) -> None:
    run = make_run()
    admit(run, join("a"))
    with pytest.raises(Refused, match="onnxruntime") as no:
        admit(run, replace(join("b"), numerics_class="other"))
    assert no.value.code == "other_numerics"
    run.hello = replace(run.hello, allow_inexact=True)
    assert run.progress.exact
    admit(run, replace(join("b"), numerics_class="other"))
    assert not run.progress.exact


def test_another_environment_is_refused(make_run: Callable[..., Run]) -> None:
    with pytest.raises(Refused) as no:
        admit(make_run(), replace(join("a"), environment=replace(SPEC, max_episode_steps=5)))
    assert no.value.code == "other_environment"


def test_actors_in_quarantine_and_too_many_are_refused(
    make_run: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run()
    with run.store.transaction():
        run.quarantined.add("liar", "it lied")
    with pytest.raises(Refused, match="it lied"):
        admit(run, join("liar"))
    monkeypatch.setattr(admission, "MOST_ACTORS", 1)
    admit(run, join("a"))
    run.dealer.join(join("a"), 0.0)
    with pytest.raises(Refused) as no:
        admit(run, join("b"))
    assert no.value.code == "too_many_actors"
    admit(run, replace(join("l"), role="learner"))
