"""Only a learner needs torch: everything else can be imported without it."""

import subprocess
import sys

import pytest

#: Modules that actors, the replay service, commands that read runs, and users of agents import.
MODULES = (
    "udrl.folder", "udrl.inference", "udrl.obedience_statistics", "udrl.policy", "udrl.rollout",
    "udrl_actor.actor_service", "udrl_replay.replay_service", "udrl_board.app",
    "udrl_board.board_command", "udrl_inspect.agents", "udrl_launch.api", "udrl_launch.cli",
    "udrl_launch.subcommands.export_command", "udrl_launch.subcommands.obedience_command",
    "udrl_launch.subcommands.play_command", "udrl_launch.subcommands.service_commands",
    "udrl_launch.subcommands.train_command", "udrl_show.event_files", "udrl_inspect.exporting",
    "udrl_launch.roles",
)  # fmt: skip

WITHOUT = "import sys; sys.modules['torch'] = None; "


def python(program: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", WITHOUT + program],
        capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip


def test_only_the_learner_needs_torch() -> None:
    program = "import importlib; [importlib.import_module(n) for n in sys.argv[1:]]"
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT + program, *MODULES],
        capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "torch" in python("import udrl_learner.learner_service").stderr


@pytest.mark.parametrize(
    "program",
    [
        "import udrl; udrl.train('CartPole-v1', run_dir=sys.argv[-1] + '/never')",
        "from udrl_launch.roles import learner; learner(None, None)",
    ],
)
def test_training_without_torch_names_the_extra(program: str) -> None:
    done = python(program)
    assert done.returncode == 1
    assert 'training needs torch; install it with: pip install "udrl[train]"' in done.stderr


def test_training_does_not_import_torchs_compiler() -> None:
    program = (
        "import sys; from udrl.algorithm1 import algorithm1; "
        "from udrl.config import Budget, Config, build; "
        "config = build(Config, {'environment': 'Figure2-v0', 'max_return': 2.0, "
        "'n_warm_up_episodes': 3, 'n_updates_per_iter': 2, 'lead': 0}); "
        "run = algorithm1(config, Budget(max_env_steps=20)); "
        "assert run.iteration > 0; print('torch._dynamo' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=100, check=False
    )
    assert done.stdout == "False\n", done.stderr
