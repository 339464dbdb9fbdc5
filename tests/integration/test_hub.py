"""Uploads to and downloads from a local stand-in for the Hugging Face Hub."""

import base64
import hashlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from huggingface_hub import ModelCard

import udrl
from udrl.errors import ConfigError
from udrl_inspect.agents import load_agent
from udrl_inspect.inspection import read_status

TOKEN = "hf_secret"


class Hub(ThreadingHTTPServer):
    """The Hub's replies to uploads and downloads of small files in model repositories."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.files: dict[str, bytes] = {}
        self.commits: list[dict[str, Any]] = []
        self.private: bool | None = None  # None: no repository
        self.claimed_size: int | None = None

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"

    @property
    def sha(self) -> str:
        return f"{len(self.commits):040}"


class _Handler(BaseHTTPRequestHandler):
    server: Hub

    def log_message(self, format: str, *args: Any) -> None: ...  # noqa: A002 - its name there

    def _answer(self, value: object, status: int = 200, **headers: str) -> None:
        body = value if isinstance(value, bytes) else json.dumps(value).encode()
        self.send_response(status)
        for name, text in headers.items():
            self.send_header(name.replace("_", "-"), text)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def do_POST(self) -> None:
        hub = self.server
        body = self.rfile.read(int(self.headers["Content-Length"]))
        if self.headers.get("Authorization") != f"Bearer {TOKEN}":
            self._answer({"error": "Unauthorized"}, 401)
        elif self.path == "/api/repos/create":
            if hub.private is not None:
                self._answer({"url": f"{hub.address}/me/lander"}, 409)
                return
            hub.private = json.loads(body)["visibility"] == "private"
            self._answer({"url": f"{hub.address}/me/lander"})
        elif self.path == "/api/validate-yaml":
            self._answer({"errors": [], "warnings": []})
        elif self.path == "/api/models/me/lander/preupload/main":
            names = [file["path"] for file in json.loads(body)["files"]]
            files = [{"path": n, "uploadMode": "regular", "shouldIgnore": False} for n in names]
            self._answer({"files": files})
        elif self.path == "/api/models/me/lander/commit/main":
            header, *added = map(json.loads, body.splitlines())
            hub.commits.append(header["value"])
            for line in added:
                hub.files[line["value"]["path"]] = base64.b64decode(line["value"]["content"])
            commit = {
                "commitUrl": f"{hub.address}/me/lander/commit/{hub.sha}",
                "commitOid": hub.sha,
            }
            self._answer(commit | {"hookOutput": ""})
        else:
            self._answer({"error": self.path}, 404)

    def do_GET(self) -> None:
        hub = self.server
        path = self.path.partition("?")[0]
        if path.startswith("/api/models/me/lander") and hub.private is not None:
            siblings = [
                {"rfilename": name, "size": hub.claimed_size or len(content)}
                for name, content in hub.files.items()
            ]
            found = {"id": "me/lander", "sha": hub.sha, "private": hub.private}
            self._answer(found | {"siblings": siblings})
        elif (name := path.rpartition("/")[2]) in hub.files and f"/resolve/{hub.sha}/" in path:
            content = hub.files[name]
            etag = f'"{hashlib.sha256(content).hexdigest()}"'
            self._answer(content, ETag=etag, X_Repo_Commit=hub.sha)
        else:
            self._answer({"error": "Repository not found"}, 404, X_Error_Code="RepoNotFound")

    def do_HEAD(self) -> None:
        self.do_GET()


@pytest.fixture
def hub() -> Iterator[Hub]:
    with Hub() as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server
        server.shutdown()
        thread.join(10)


def run(hub: Hub, home: Path, *arguments: object, token: str = TOKEN) -> tuple[int, str, str]:
    """Run Python with this Hub; huggingface_hub reads its address on import."""
    environment = os.environ | {
        "HF_ENDPOINT": hub.address, "HF_HOME": str(home), "HF_TOKEN": token,
        "HF_HUB_DISABLE_XET": "1", "HF_HUB_DISABLE_PROGRESS_BARS": "1",
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-W", "error", *map(str, arguments)], env=environment,
        capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    return done.returncode, done.stdout, done.stderr


def export(
    hub: Hub, home: Path, run_dir: Path, *options: str, **given: str
) -> tuple[int, str, str]:
    command = "-m", "udrl_launch", "export", run_dir, "--hub", "me/lander", *options
    return run(hub, home, *command, **given)


LOAD = (
    "import sys, udrl\n"
    "from udrl.errors import UdrlError\n"
    "try:\n"
    "    policy = udrl.load(sys.argv[1])\n"
    "    print(policy.logits([0.1, 0.2, -0.3, 0.4], 70.0, 50).tolist())\n"
    "except UdrlError as error:\n"
    "    print(f'{type(error).__name__}: {error}')\n"
)


def test_agent_is_uploaded_in_one_commit_and_loaded_again(
    ended_run: Path, tmp_path: Path, hub: Hub
) -> None:
    code, out, err = export(hub, tmp_path, ended_run)
    assert code == 0, err
    assert f'Hub: {hub.address}/me/lander; in Python: udrl.load("hf://me/lander")\n' in out
    assert hub.private is True
    assert len(hub.commits) == 1
    assert set(hub.files) == {
        "README.md", "config.json", "config.toml", "model.onnx", "model.safetensors"
    }  # fmt: skip
    agent = load_agent(ended_run)
    assert hub.files["model.safetensors"] == agent.weights
    assert hub.files["model.onnx"] == agent.behavior.model
    everything = b"".join(hub.files.values())
    assert TOKEN.encode() not in everything
    assert str(ended_run).encode() not in everything

    text = hub.files["README.md"].decode()
    last = read_status(ended_run).final_evaluation
    assert last is not None
    card: Any = ModelCard(text).data
    (result,) = card.eval_results
    assert result.metric_type == "mean_reward"
    assert result.metric_value.startswith(f"{last.mean:.1f} +/- ")
    assert card.library_name == "udrl"
    assert {"reinforcement-learning", "CartPole-v1"} <= set(card.tags)
    assert 'udrl.load("hf://me/lander")' in text
    assert "`udrl[hub]`" in text

    expected = agent.policy.logits([0.1, 0.2, -0.3, 0.4], 70.0, 50).tolist()
    for address in ("hf://me/lander", f"hf://me/lander@{hub.sha}"):
        code, out, err = run(hub, tmp_path, "-c", LOAD, address)
        assert (code, out) == (0, f"{expected}\n"), err
    hub.claimed_size = 5 << 30
    _, out, _ = run(hub, tmp_path, "-c", LOAD, "hf://me/lander")
    assert out.startswith("InvalidData: hf://me/lander: config.json has 5368709120 bytes")


@pytest.mark.parametrize(("private", "options"), [(False, []), (True, ["--public"])])
def test_repository_of_another_visibility_is_not_changed(
    ended_run: Path, tmp_path: Path, hub: Hub, private: bool, options: list[str]
) -> None:
    hub.private = private
    code, _, err = export(hub, tmp_path, ended_run, *options)
    assert code == 2
    assert f"me/lander exists and is {'private' if private else 'public'}; " in err
    assert not hub.files
    assert not hub.commits


def test_public_repository_is_created_on_request(ended_run: Path, tmp_path: Path, hub: Hub) -> None:
    code, _, err = export(hub, tmp_path, ended_run, "--public")
    assert code == 0, err
    assert hub.private is False


def test_error_of_the_hub_is_reported(ended_run: Path, tmp_path: Path, hub: Hub) -> None:
    code, _, err = export(hub, tmp_path, ended_run, token="hf_other")
    assert code == 2
    assert "udrl: error: the Hub refused me/lander: " in err
    assert "log in with: hf auth login" in err
    _, out, _ = run(hub, tmp_path, "-c", LOAD, "hf://me/lander")
    assert out.startswith("ConfigError: the Hub refused me/lander: ")
    _, out, _ = run(hub, tmp_path, "-c", LOAD, "hf://a/b/c")
    assert out.startswith("ConfigError: a/b/c: ")


def test_unresponsive_hub_is_unreachable(tmp_path: Path) -> None:
    with Hub() as closed:
        pass
    _, out, err = run(closed, tmp_path, "-c", LOAD, "hf://me/lander")
    assert out.startswith("Unreachable: the Hugging Face Hub did not respond for me/lander: "), err


def test_missing_extra_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub.errors", None)
    with pytest.raises(ConfigError, match=r'pip install "udrl\[hub\]"'):
        udrl.load("hf://me/lander")
