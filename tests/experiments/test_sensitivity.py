from pathlib import Path

import pytest

from udrl.errors import StoreError
from udrl_experiments.comparison import job
from udrl_experiments.protocol import TASKS, StudyPlan
from udrl_experiments.sensitivity import sensitivity_study
from udrl_experiments.study import StudyFolders


def test_agents_of_the_papers_preset_are_a_study_of_their_own() -> None:
    plan, task = StudyPlan(seeds=(1,)), TASKS["sparse"]
    study = sensitivity_study(plan, [task], "UDRL-paper")
    assert (study.name, study.jobs) == ("sensitivity-paper", [job(task, plan, "UDRL-paper", 1)])
    assert sensitivity_study(plan, [task]).name == "sensitivity"


def test_missing_agent_is_reported(tmp_path: Path) -> None:
    study = sensitivity_study(StudyPlan(seeds=(1,)), [TASKS["sparse"]])
    (run,) = study.jobs
    expected = rf"UDRL, LunarLanderSparse-v3, seed 1.*delete {run.folder(tmp_path)} to repeat it"
    with pytest.raises(StoreError, match=expected):
        study.report(StudyFolders(tmp_path, tmp_path / "sensitivity"))
