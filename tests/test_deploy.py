"""Deployment files agree with each other, with their schemas, and with the program."""

import re
import shlex
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml

from tests.markdown import ROOT
from tests.test_docs_examples import check_udrl

KUBERNETES = ROOT / "deploy" / "kubernetes"
MANIFESTS = sorted(KUBERNETES.glob("*.yaml"))
VERSION = "1.31"

#: Keys that Swarm reads elsewhere, below ``deploy`` or ``volumes``, or ignores.
ONLY_COMPOSE = {"build", "depends_on", "restart", "scale", "security_opt", "tmpfs"}


def load(path: Path) -> Any:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def services(file: str) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = load(ROOT / file)["services"]
    return found


def documents(path: Path) -> Iterator[dict[str, Any]]:
    yield from yaml.safe_load_all(path.read_text(encoding="utf-8"))


def test_swarm_runs_the_services_of_compose() -> None:
    stack, compose = services("deploy/stack.yaml"), services("compose.yaml")
    assert stack.keys() == compose.keys()
    for name, service in compose.items():
        same = {key: value for key, value in service.items() if key not in ONLY_COMPOSE}
        same["volumes"] = [
            *({"type": "tmpfs", "target": target} for target in service["tmpfs"]),
            *service.get("volumes", ()),
        ]
        deploy = stack[name].pop("deploy")
        assert stack[name] == same
        assert deploy.get("replicas", 1) == service.get("scale", 1)
        assert deploy["restart_policy"]["condition"] == service["restart"]


def test_torch_is_in_the_image_of_the_learner_only() -> None:
    dockerfile = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    assert re.findall(r"^FROM (\S+) AS (?:actor|learner)$", dockerfile, flags=re.MULTILINE) == [
        "${BASE_IMAGE:-python:3.11-slim-bookworm}",
        "actor",
    ]
    compose = services("compose.yaml")
    targets = {name: s["build"]["target"] for name, s in compose.items() if "build" in s}
    assert targets == {"replay": "actor", "learner": "learner"}
    assert {name for name, s in compose.items() if s["image"].endswith("-learner")} == {"learner"}
    assert compose["actor"]["image"] == compose["replay"]["image"]
    assert "TORCH_INDEX" not in compose["replay"]["build"]["args"]


def test_documented_custom_images_match_the_dockerfile() -> None:
    """The documented build depends on these places of the Dockerfile."""
    page = (ROOT / "docs" / "operations.md").read_text(encoding="utf-8")
    page = page.split("\n#### An environment of your own\n")[1].split("\n### ")[0]
    dockerfile = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    assert "pip --python /opt/udrl/bin/python install" in page
    assert "RUN python3 -m venv /opt/udrl" in dockerfile
    assert "pip uninstall --yes pip" in dockerfile, "so that PATH finds the base image's pip"
    actor, learner = dockerfile.split(" AS actor\n")[1].split("FROM actor AS learner")
    assert "USER udrl" in page
    assert "\nUSER udrl\n" in actor
    assert "PYTHONPATH" not in actor, "custom images may set it"
    assert "PYTHONPATH=/opt/torch" in learner
    images = {name: service["image"] for name, service in services("compose.yaml").items()}
    assert images["actor"] == images["replay"] == "${UDRL_IMAGE:-udrl}"
    assert "${ENV:-" in services("compose.yaml")["replay"]["command"]


def test_insecure_overrides_publish_no_port() -> None:
    overrides = ["compose.secure.yaml", "compose.gpu.yaml"]
    assert "--insecure" in services("compose.yaml")["replay"]["command"]
    assert not any("ports" in service for service in services("compose.yaml").values())
    # Independent of the order of files, only the secure one may set commands or publish ports.
    for file in overrides:
        for service in services(file).values():
            assert file == "compose.secure.yaml" or not {"command", "ports"} & service.keys()
            assert "--insecure" not in service.get("command", "")


def commands(file: str) -> Iterator[list[str]]:
    for service in services(file).values():
        if "command" in service:
            filled = re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", service["command"])
            yield shlex.split(filled)
        if "healthcheck" in service:
            kind, program, *words = service["healthcheck"]["test"]
            assert (kind, program) == ("CMD", "udrl")
            yield words


@pytest.mark.parametrize("file", ["compose.yaml", "compose.secure.yaml", "deploy/stack.yaml"])
def test_container_commands_are_valid(file: str) -> None:
    found = list(commands(file))
    assert found
    for words in found:
        check_udrl(words)


@pytest.mark.parametrize("path", MANIFESTS, ids=lambda path: path.name)
def test_manifests_match_the_kubernetes_schemas(path: Path) -> None:
    for document in documents(path):
        if document["kind"] != "Kustomization":  # for a program, not for the cluster
            kubernetes_validate.validate(document, VERSION, strict=True)


def test_schemas_reject_a_misspelt_field() -> None:
    document = next(documents(KUBERNETES / "actor.yaml"))
    document["spec"]["replica"] = 2
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(document, VERSION, strict=True)


def workloads() -> Iterator[dict[str, Any]]:
    for path in MANIFESTS:
        yield from (d for d in documents(path) if d["kind"] in ("Deployment", "StatefulSet"))


def test_kubernetes_runs_the_services_of_compose() -> None:
    found = {workload["metadata"]["name"]: workload for workload in workloads()}
    assert found.keys() == services("compose.yaml").keys()
    settings = load(KUBERNETES / "kustomization.yaml")["configMapGenerator"][0]["literals"]
    values = dict(text.split("=") for text in settings)
    for name, workload in found.items():
        (container,) = workload["spec"]["template"]["spec"]["containers"]
        words = [re.sub(r"\$\((\w+)\)", lambda m: values[m[1]], w) for w in container["args"]]
        assert words[0] == name
        assert container["image"] == ("udrl-learner" if name == "learner" else "udrl")
        check_udrl(words)
        for probe in ("readinessProbe", "livenessProbe"):
            if probe in container:
                program, *arguments = container[probe]["exec"]["command"]
                assert program == "udrl"
                check_udrl(arguments)


def test_autoscaler_scales_actors_only() -> None:
    counted = {w["metadata"]["name"]: w["spec"].get("replicas") for w in workloads()}
    assert counted == {"replay": 1, "learner": 1, "actor": None}


def test_kustomization_lists_every_manifest() -> None:
    named = load(KUBERNETES / "kustomization.yaml")["resources"]
    assert sorted([*named, "kustomization.yaml"]) == [path.name for path in MANIFESTS]


def test_kustomization_lists_every_image() -> None:
    named = {image["name"] for image in load(KUBERNETES / "kustomization.yaml")["images"]}
    used = {
        container["image"]
        for workload in workloads()
        for container in workload["spec"]["template"]["spec"]["containers"]
    }
    assert named == used


def test_slurm_script_requests_its_resources() -> None:
    script = ROOT / "deploy" / "slurm" / "actors.sbatch"
    done = subprocess.run(
        ["bash", str(script)], capture_output=True, text=True, timeout=10, env={"PATH": "/bin"}
    )
    assert done.returncode == 1
    assert "UDRL_ENDPOINT: is not set; e.g." in done.stderr
    (command,) = re.findall(r"^exec udrl (.*)$", script.read_text(), flags=re.MULTILINE)
    filled = command.replace('"$UDRL_ENDPOINT"', "tls/host:7447").replace('"$UDRL_KEYS"', "keys")
    check_udrl(shlex.split(filled))
