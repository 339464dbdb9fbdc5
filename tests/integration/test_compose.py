"""``docker compose up`` under faults gives the result of a single process."""

import re
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from compose_project import IMAGE, LEARNER_IMAGE, Project, run
from udrl_proto import PROTOCOL
from udrl_proto.reports import Status
from whole_run import Cli, assert_conserved, digests, free_port, wait_for

pytestmark = [pytest.mark.compose, pytest.mark.timeout(2400)]

#: More env steps than any test waits for.
ENDLESS = 10**9
PLAIN = ("--connect", "tcp/127.0.0.1:7447")
WITH_KEYS = ("--connect", "tls/127.0.0.1:7447", "--keys", "/keys")
SECURE = ["compose.yaml", "compose.secure.yaml"]
OUTSIDE = "udrl-test-outside"
#: Addresses of the external actor's network, whose gateway is this machine.
SUBNET, GATEWAY = "10.213.7.0/24", "10.213.7.1"


def arguments(env_steps: int) -> str:
    return f"--seed 5 --max-env-steps {env_steps}"


def run_alone(cli: Callable[..., Cli], env_steps: int, run_dir: Path) -> Status:
    """Return the status of the same run in one process, without containers."""
    given = ["train", "CartPole-v1", "--in-process", "--run-dir", str(run_dir), "--json"]
    return cli(*given, *arguments(env_steps).split()).status(timeout=600)


@pytest.fixture(scope="module", autouse=True)
def _images() -> None:
    """The images of this checkout; skips the tests without an engine."""
    Project("udrl-test-image", ["compose.yaml"], {}).compose("build", timeout=1800)


@pytest.fixture
def external_network() -> Iterator[str]:
    """A network that is connected to the project's published port only."""
    subprocess.run(["docker", "network", "rm", OUTSIDE], capture_output=True, timeout=60)
    run("docker", "network", "create", "--subnet", SUBNET, "--gateway", GATEWAY, OUTSIDE)
    yield OUTSIDE
    run("docker", "network", "rm", OUTSIDE)


def finished(project: Project, *up: str) -> Status:
    """Extend a run's budget so that it ends soon; return its final status.

    Args:
        project: not running, except for services given here.
        up: arguments of ``docker compose up``.
    """
    status = project.store()
    # Longer than it takes to find a new replay service healthy and to start the others.
    steps = status.env_steps + 150_000
    project.set_variables(ARGS=arguments(steps))
    project.compose("up", "--detach", *up)
    assert project.exit_codes("replay") == [0]
    ended = project.store()
    assert_conserved(ended)
    assert ended.max_env_steps == steps
    return ended


def test_down_and_up_resumes_and_no_port_is_published(
    cli: Callable[..., Cli], tmp_path: Path
) -> None:
    variables = {"ENV": "CartPole-v1", "ARGS": arguments(ENDLESS)}
    with Project("udrl-test-plain", ["compose.yaml"], variables) as project:
        project.compose("up", "--detach")
        wait_for(lambda: (s := project.live(*PLAIN)) and s.iteration > 3, "some iterations", 120)
        for service in ("replay", "learner", "actor"):
            for container in project.containers(service):
                assert run("docker", "port", container) == ""
        project.compose("stop")
        for service in ("replay", "learner", "actor"):
            # They exited by themselves, before the timeout of Compose.
            assert set(project.exit_codes(service)) <= {0, 143}, service
        project.compose("down")
        ended = finished(project)
    assert digests(ended) == digests(run_alone(cli, ended.max_env_steps, tmp_path / "alone"))


def test_faults_and_an_external_actor_change_nothing(
    cli: Callable[..., Cli], tmp_path: Path, external_network: str
) -> None:
    port = free_port()
    variables = {"ENV": "CartPole-v1", "ARGS": arguments(ENDLESS), "UDRL_HOST": GATEWAY}
    secure = Project("udrl-test-secure", SECURE, variables | {"UDRL_PORT": str(port)})

    def wait_for_progress(what: str, actors: int | None = None) -> None:
        """Wait until two more iterations are complete, with the given number of actors."""
        first: list[int] = []

        def has_progressed() -> bool:
            status = secure.live(*WITH_KEYS)
            if status is None or actors not in (None, len(status.actors)):
                return False
            first.append(status.iteration)
            return status.iteration > first[0] + 1

        wait_for(has_progressed, f"progress {what}", 120)

    with secure as project:
        project.compose("up", "--detach")
        wait_for_progress("at the start", 2)
        project.scale(4)
        wait_for_progress("with four actors", 4)
        project.scale(1)
        wait_for_progress("with one actor", 1)
        project.kill("replay")
        wait_for_progress("after the replay service was killed")
        project.kill("learner")
        wait_for_progress("after the learner was killed")

        (actor,) = project.containers("actor")
        network = f"{project.name}_run"
        run("docker", "network", "disconnect", network, actor)
        wait_for(
            lambda: (s := project.live(*WITH_KEYS)) and not s.actors, "the actor to be removed", 60
        )
        run("docker", "network", "connect", network, actor)
        wait_for_progress("after the network was cut", 1)

        project.scale(0)
        stranger = run(
            "docker", "run", "--detach", "--init", "--network", external_network,
            "--volume", f"{project.name}_keys-actor:/keys/actor:ro", IMAGE,
            "actor", "--connect", f"tls/{GATEWAY}:{port}", "--keys", "/keys", "--patience", "60",
        ).strip()  # fmt: skip
        try:
            wait_for_progress("with the actor from outside alone", 1)
            ended = finished(project, "--no-deps", "replay")
            assert run("docker", "wait", stranger, timeout=60).strip() == "0"
        finally:
            run("docker", "rm", "--force", stranger)
    assert digests(ended) == digests(run_alone(cli, ended.max_env_steps, tmp_path / "alone"))


def shell_in(image: str) -> list[str]:
    """Return the command that runs a line of shell in an image."""
    return ["docker", "run", "--rm", "--read-only", "--entrypoint", "sh", image, "-c"]


@pytest.mark.parametrize("image", [IMAGE, LEARNER_IMAGE])
def test_image_runs_unprivileged_and_has_no_build_tools(image: str) -> None:
    inside = shell_in(image)
    assert run(*inside, "id -u").strip() == "10001"
    tools = "for tool in cc gcc c++ ld make cmake; do command -v $tool || true; done"
    assert run(*inside, tools).strip() == ""
    assert run(*inside, "for tool in sh udrl; do command -v $tool || true; done").count("\n") == 2
    assert run(*inside, "python -c 'import pip' 2>/dev/null || echo none").strip() == "none"
    assert run(*inside, "python -c 'import setuptools' 2>/dev/null || echo none") == "none\n"
    ours = "find /opt/udrl/lib/python3*/site-packages/udrl* /runs -name 'test_*'"
    assert run(*inside, ours).strip() == ""


def test_torch_is_in_the_image_of_the_learner_only() -> None:
    look = "python -c 'import torch; print(torch.__name__)' 2>/dev/null || echo none"
    assert run(*shell_in(LEARNER_IMAGE), look) == "torch\n"
    assert run(*shell_in(IMAGE), look) == "none\n"
    assert run(*shell_in(IMAGE), "find / -xdev -name 'libtorch*' 2>/dev/null || true") == ""


# Errors are in the log and exit code of the container that fails.


def run_container(
    *arguments: str, options: tuple[str, ...] = (), image: str = IMAGE
) -> tuple[int, str]:
    """Return exit code and log of a container that exits by itself."""
    command = ["docker", "run", "--rm", "--init", "--read-only", "--tmpfs", "/tmp", *options]
    done = subprocess.run([*command, image, *arguments], capture_output=True, text=True, timeout=90)
    assert "Traceback" not in done.stderr
    return done.returncode, done.stderr


def test_unwritable_volume_is_reported(tmp_path: Path) -> None:
    tmp_path.chmod(0o755)  # owned by the user of the tests instead of user 10001
    code, log = run_container(
        "replay", "CartPole-v1", "--run-dir", "/runs/one", "--listen", "tcp/127.0.0.1:7447",
        options=("--volume", f"{tmp_path}:/runs"),
    )  # fmt: skip
    assert code == 8
    assert "/runs/one" in log
    assert "Permission denied" in log


def test_missing_keys_are_reported() -> None:
    code, log = run_container("actor", "--connect", "tls/replay:7447", "--keys", "/keys")
    assert code == 2
    assert "/keys/actor/ca.pem: No such file" in log
    assert "udrl keys create" in log


def test_missing_replay_service_is_reported() -> None:
    code, log = run_container(
        "learner", "--connect", "tcp/127.0.0.1:7447", "--patience", "3", image=LEARNER_IMAGE
    )
    assert code == 6
    # The elapsed time: 3 s, or more on a busy machine.
    assert re.search(r"no reply from 'tcp/127\.0\.0\.1:7447' after \d+ s; start `udrl replay", log)


def test_learner_without_torch_is_reported() -> None:
    code, log = run_container("learner", "--connect", "tcp/127.0.0.1:7447", "--patience", "3")
    assert code == 2
    assert 'training needs torch; install it with: pip install "udrl[train]"' in log


def test_image_of_another_protocol_is_reported(tmp_path: Path) -> None:
    tag = "udrl-test-other-protocol"
    (tmp_path / "Dockerfile").write_text(
        f"FROM {IMAGE}\nUSER root\n"
        "RUN sed -i 's/^PROTOCOL = .*/PROTOCOL = 999/' /opt/udrl/lib/python3*/site-packages/"
        "udrl_proto/__init__.py\nUSER udrl\n"
    )
    run("docker", "build", "--tag", tag, str(tmp_path))
    variables = {"ENV": "CartPole-v1", "ARGS": arguments(ENDLESS)}
    with Project("udrl-test-other", ["compose.yaml"], variables) as project:
        project.compose("up", "--detach")
        network = ("--network", f"{project.name}_run")
        code, log = run_container(
            "actor", "--connect", "tcp/replay:7447", options=network, image=tag
        )
        assert code == 2
        assert f"the run speaks protocol {PROTOCOL}, this program speaks 999" in log
        assert "install the same version of udrl on both sides" in log
        wait_for(lambda: (s := project.live(*PLAIN)) and s.iteration > 3, "progress", 120)
    run("docker", "image", "rm", tag)
