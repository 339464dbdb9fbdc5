from pathlib import Path

import pytest

from udrl.errors import StoreError
from udrl_experiments.protocol import TASKS, StudyPlan
from udrl_experiments.sensitivity import sensitivity_study
from udrl_experiments.study import StudyFolders


def test_missing_agent_is_reported(tmp_path: Path) -> None:
    study = sensitivity_study(StudyPlan(seeds=(1,)), [TASKS["sparse"]])
    (run,) = study.jobs
    expected = rf"UDRL, LunarLanderSparse-v3, seed 1.*delete {run.folder(tmp_path)} to repeat it"
    with pytest.raises(StoreError, match=expected):
        study.report(StudyFolders(tmp_path, tmp_path / "sensitivity"))
