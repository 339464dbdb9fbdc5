"""The wheel is complete and works outside the checkout."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from whole_run import TOY, arguments

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory with the wheel's content."""
    out = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(out)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = out.glob("udrl-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(out / "site")
    return out / "site"


def run_outside(site: Path, *command: str) -> str:
    """Run Python with the wheel's packages only."""
    environment = os.environ | {"PYTHONPATH": str(site)}
    done = subprocess.run(
        [sys.executable, "-W", "error", *command],
        cwd=site.parent,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_installed_wheel_trains(site: Path) -> None:
    imported = run_outside(site, "-c", "import udrl, udrl_launch; print(udrl.__file__)")
    assert Path(imported.strip()).is_relative_to(site)
    trained = run_outside(
        site, "-m", "udrl_launch", *arguments(TOY, 100, site.parent / "run"), "--in-process"
    )
    assert '"state":"ended"' in trained


def test_wheel_ships_presets_and_types_but_no_tests(site: Path) -> None:
    files = {str(path.relative_to(site)) for path in site.rglob("*") if path.is_file()}
    assert {f"udrl/presets/{n}.toml" for n in ("CartPole-v1", "LunarLander-v3")} <= files
    spaces = {f"udrl_experiments/spaces/{n}.toml" for n in ("LunarLander-v3", "baselines")}
    assert spaces | {"udrl_experiments/tuned.toml"} <= files
    packages = (
        "udrl", "udrl_proto", "udrl_actor", "udrl_learner", "udrl_replay", "udrl_inspect",
        "udrl_show", "udrl_launch",
        "udrl_board", "udrl_experiments",
    )  # fmt: skip
    assert {f"{package}/py.typed" for package in packages} <= files
    assert {f"udrl_board/static/{n}" for n in ("index.html", "vendor/uplot/LICENSE")} <= files
    top_level = {name.split("/")[0] for name in files if "dist-info" not in name}
    assert top_level == set(packages)
