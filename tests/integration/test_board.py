"""The board's server on real runs: updates, access, and the stage."""

import json
import os
import re
import shutil
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec
import pytest
from click.testing import CliRunner
from starlette.testclient import TestClient
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocketDisconnect

from test_spaces import SETTINGS
from udrl.config import Config, build
from udrl.errors import ConfigError, StoreError, Unreachable
from udrl_board import app as board
from udrl_board import source, stage
from udrl_board.app import make_app
from udrl_board.board_command import board as command
from udrl_board.feed import Feed
from udrl_board.source import Directory, Served, Stored
from udrl_board.stage import Stage
from udrl_inspect.address import ENDPOINT_FILE, Address
from udrl_inspect.agents import load_agent
from udrl_inspect.inspection import read_status
from udrl_inspect.obedience_report import measure, plan_commands, save_report
from udrl_inspect.obedience_text import summary
from udrl_launch.cli import cli as command_line
from udrl_proto.messages import Hello
from udrl_proto.reports import Status
from whole_run import TOY, Cli, arguments, free_port, live_status, wait_for


def page(run_dir: Path, **options: Any) -> TestClient:
    return TestClient(make_app(Feed(Directory(run_dir)), **options), base_url="http://127.0.0.1")


@pytest.fixture
def client(ended_run: Path) -> Iterator[TestClient]:
    with page(ended_run) as client:
        yield client


# Updates.


def scripts(client: TestClient) -> list[str]:
    """Return all scripts that the page loads, directly or through another one."""
    found = re.findall(r'<script .*src="([^"]+)"', client.get("/").text)
    for name in found:
        imported = re.findall(r'^import .* from "\./([^"]+)"', client.get(name).text, re.MULTILINE)
        found += [one for one in imported if one not in found]
    return found


def test_page_and_its_assets_are_served(client: TestClient) -> None:
    main = client.get("/")
    assert "<title>udrl board</title>" in main.text
    assert "default-src 'none'" in main.headers["content-security-policy"]
    assert main.headers["x-content-type-options"] == "nosniff"
    for part in ("board.css", "vendor/uplot/LICENSE", *scripts(client)):
        assert client.get(f"/{part}").status_code == 200
    assert client.get("/../app.py").status_code == 404
    assert "://" not in main.text.replace("http://www.w3.org", ""), (
        "the page must be self-contained"
    )


def test_updates_of_an_ended_run(client: TestClient, ended_run: Path) -> None:
    news = client.get("/news", params={"after": -1}).json()
    status = read_status(ended_run)
    assert msgspec.convert(news["status"], Status) == status
    assert [i["iteration"] for i in news["iterations"]] == list(range(status.iteration + 1))
    assert news["evaluations"]
    assert len(news["contents"]["returns"]) >= status.buffer.episodes
    known: dict[str, str | int] = {"after": status.iteration, "run": status.run_id}
    assert client.get("/news", params=known).json()["iterations"] == []


def test_updates_have_the_report_on_obedience(ended_run: Path, tmp_path: Path) -> None:
    run_dir = Path(shutil.copytree(ended_run, tmp_path / "run"))
    agent = load_agent(run_dir)
    report = measure(agent, plan_commands(agent, points=2, episodes=2))
    save_report(run_dir, report)
    with page(run_dir) as client:
        found = client.get("/news").json()["obeyed"]
    assert (found["answer"], found["weights_version"]) == (summary(report), agent.version)


def test_several_runs_are_listed(ended_run: Path, tmp_path: Path) -> None:
    other = Path(shutil.copytree(ended_run, tmp_path / "other"))
    app = make_app(Feed(Directory(ended_run)), Feed(Directory(other)))
    with TestClient(app, base_url="http://127.0.0.1") as client:
        rows = client.get("/runs").json()
        assert [row["place"]["run_dir"] for row in rows] == [str(ended_run), str(other)]
        assert all(row["evaluations"] and row["status"]["state"] == "ended" for row in rows)
        for number, run_dir in (("0", ended_run), ("1", other), ("7", ended_run), ("x", ended_run)):
            news = client.get("/news", params={"number": number}).json()
            assert news["place"]["run_dir"] == str(run_dir)
        with client.websocket_connect("/stage?number=1") as socket:
            socket.send_json(start(paused=True))
            assert next(moments(socket))["step"] == 0


@pytest.mark.parametrize("after", ["x", "1.5", "--1", "9" * 40])
def test_invalid_queries_are_rejected(client: TestClient, after: str) -> None:
    answer = client.get("/news", params={"after": after})
    assert answer.status_code == 400
    assert "expected an iteration" in answer.text


def test_stored_and_served_run_give_the_same_updates(
    cli: Callable[..., Cli], tmp_path: Path
) -> None:
    endpoint, run_dir = f"tcp/127.0.0.1:{free_port()}", tmp_path / "run"
    process = cli(*arguments(TOY, 10_000_000, run_dir), "--listen", endpoint, "--actors", "1")
    wait_for(lambda: (s := live_status(run_dir)) and s.iteration > 3, "some iterations")
    with (
        closing(Served(Address(endpoint))) as served,
        closing(Directory(run_dir)) as directory,
    ):
        stored = Stored(run_dir)
        assert served.hello().run_id == directory.hello().run_id == stored.hello().run_id
        assert served.status().actors
        assert directory.status().actors, "the service of the directory must be queried"
        first = served.history(-1).iterations[:3]
        assert first == directory.history(-1).iterations[:3] == stored.history(-1).iterations[:3]
        assert served.contents().returns
        assert stored.contents().returns
        version = served.weights("latest")
        assert version.weights
        process.process.terminate()
        process.finish()
        with pytest.raises(Unreachable):
            served.status()
        assert not directory.status().actors
        assert directory.contents() == stored.contents()
        assert directory.weights("latest") == stored.weights("latest")


def test_unresponsive_service_is_not_queried_again_at_once(
    cli: Callable[..., Cli], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_dir = tmp_path / "run"
    cli(*arguments(TOY, 10_000_000, run_dir), "--actors", "1")
    wait_for(lambda: (s := live_status(run_dir)) and s.iteration > 3, "some iterations")
    service = json.loads((run_dir / ENDPOINT_FILE).read_text())["pid"]
    with closing(Directory(run_dir)) as directory:
        assert directory.place().endpoint.startswith("tcp/127.0.0.1:")
        assert directory.status().actors
        assert directory.doubt() == ""
        os.kill(service, signal.SIGSTOP)
        try:
            assert directory.status().actors == ()
            assert "the board shows the run's file: " in directory.doubt()

            def query(*_: object) -> None:
                raise AssertionError("queried again at once")

            with monkeypatch.context() as patch:
                patch.setattr(Served, "_query", query)
                assert directory.status().actors == ()
        finally:
            os.kill(service, signal.SIGCONT)
        monkeypatch.setattr(source, "_SILENT_S", 0.0)
        wait_for(lambda: directory.status().actors and not directory.doubt(), "a reply")


def test_new_run_at_the_place_of_a_removed_one_is_queried(
    cli: Callable[..., Cli], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(source, "_SILENT_S", 0.0)
    endpoint, run_dir = f"tcp/127.0.0.1:{free_port()}", tmp_path / "run"
    with closing(Directory(run_dir)) as directory:
        for _ in range(2):
            process = cli(*arguments(TOY, 10_000_000, run_dir), "--listen", endpoint)
            wait_for(lambda: (s := live_status(run_dir)) and s.actors, "an actor")
            wait_for(lambda: directory.status().actors, "the service to be queried")
            process.process.terminate()
            process.finish()
            shutil.rmtree(run_dir)


# Access.


def test_board_checks_the_host_header(ended_run: Path) -> None:
    with page(ended_run, hosts=("127.0.0.1", "localhost")) as client:
        assert client.get("/").status_code == 200
        answer = client.get("/", headers={"host": "evil.example"})
        assert answer.status_code == 421
        assert client.get("/news", headers={"host": "localhost:80"}).status_code == 200


@pytest.mark.parametrize("bad", [{"host": "["}, {"origin": "http://["}])
def test_invalid_headers_are_rejected(client: TestClient, bad: dict[str, str]) -> None:
    assert client.get("/", headers=bad).status_code == 400


def test_boards_use_different_cookies(ended_run: Path) -> None:
    jar: dict[str, str] = {}
    with page(ended_run, token="one") as one, page(ended_run, token="two") as two:
        for client, token in ((one, "one"), (two, "two")):
            answer = client.get("/", params={"token": token}, follow_redirects=False)
            name, _, value = answer.headers["set-cookie"].split(";")[0].partition("=")
            jar[name] = value
            client.cookies.clear()
        both = {"cookie": "; ".join(f"{name}={value}" for name, value in jar.items())}
        assert [c.get("/news", headers=both).status_code for c in (one, two)] == [200, 200]


@pytest.mark.parametrize(
    "strange", ['prefs={"theme":"dark"}', "a b c", "a/b=1", "a@b=1", "[x]=1", "=", "x=é"]
)
def test_foreign_cookies_are_ignored(ended_run: Path, strange: str) -> None:
    with page(ended_run, token="secret") as client:
        client.get("/", params={"token": "secret"})
        ((name, value),) = client.cookies.items()
        for jar in (f"{strange}; {name}={value}", f"{name}={value}; {strange}"):
            headers = {"cookie": jar.encode("utf-8")}
            client.cookies.clear()
            assert client.get("/news", headers=headers).status_code == 200  # type: ignore[arg-type]


def test_cross_origin_requests_are_rejected(client: TestClient) -> None:
    assert client.get("/news", headers={"origin": "http://evil.example"}).status_code == 403
    assert client.get("/news", headers={"origin": "http://127.0.0.1"}).status_code == 200
    with (
        pytest.raises(WebSocketDisconnect) as refused,
        client.websocket_connect("/stage", headers={"origin": "http://evil.example"}) as socket,
    ):
        socket.receive_text()
    assert refused.value.code == 1008


def test_token_is_required_and_becomes_a_cookie(ended_run: Path) -> None:
    with page(ended_run, token="open-sesame") as client:
        for path in ("/", "/news", "/board.js"):
            answer = client.get(path)
            assert answer.status_code == 401
            assert "the address that `udrl board` printed" in answer.text
        assert client.get("/", params={"token": "wrong"}).status_code == 401
        let_in = client.get("/", params={"token": "open-sesame"}, follow_redirects=False)
        assert (let_in.status_code, let_in.headers["location"]) == (303, "./")
        assert "HttpOnly" in let_in.headers["set-cookie"]
        assert "SameSite=strict" in let_in.headers["set-cookie"]
        assert client.get("/").status_code == 200
        (cookie,) = let_in.headers["set-cookie"].split(";")[:1]
        known = {"cookie": cookie}
        with client.websocket_connect("/stage", headers=known) as socket:
            socket.send_text("{}")
            assert "invalid request" in socket.receive_json()["problem"]


# The stage.


def start(**changes: Any) -> dict[str, Any]:
    usual = {
        "do": "start", "desired_return": 30.0, "desired_horizon": 40, "seed": 5,
        "temperature": 1.0, "version": "latest",
    }  # fmt: skip
    return usual | changes


def moments(socket: Any) -> Iterator[dict[str, Any]]:
    """Yield moments, each with its frame under the announced name."""
    while True:
        moment = socket.receive_json()
        if moment.get("picture"):
            moment["picture"] = socket.receive_bytes()
        yield moment


def ending(socket: Any) -> dict[str, Any]:
    return next(m for m in moments(socket) if m.get("over"))


def played(run_dir: Path, *options: object) -> dict[str, Any]:
    words = ["play", run_dir, "--episodes", 1, "--json", *options]
    result = CliRunner().invoke(
        command_line, list(map(str, words)), standalone_mode=False, catch_exceptions=False
    )
    report: dict[str, Any] = json.loads(result.stdout)
    return report


def test_stage_shows_the_episode_of_play(client: TestClient, ended_run: Path) -> None:
    with client.websocket_connect("/stage") as socket:
        for temperature in (1.0, 0.0):
            socket.send_json(start(temperature=temperature))
            first = next(moments(socket))
            assert (first["step"], first["action"], first["over"]) == (0, None, False)
            assert first["picture"].startswith(b"\xff\xd8"), "a JPEG"
            assert sum(first["probabilities"]) == pytest.approx(1)
            assert first["actions"] == [{"name": "", "values": ["push left", "push right"]}]
            last = ending(socket)
            expected = played(
                ended_run, "--seed", 5, "--desired-return", 30, "--desired-horizon", 40,
                "--temperature", temperature,
            )  # fmt: skip
            assert last["obtained"] == expected["episode_return"]
            assert last["step"] == expected["length"]
            assert (last["commanded_return"], last["commanded_horizon"]) == (30.0, 40)
            assert last["version"] == load_agent(ended_run).version


def test_pause_step_and_a_changed_command(client: TestClient) -> None:
    with client.websocket_connect("/stage") as socket:
        seen = moments(socket)
        socket.send_json(start(paused=True))
        assert next(seen)["paused"]
        for step in (1, 2):
            socket.send_json({"do": "step"})
            moment = next(seen)
            assert (moment["step"], moment["desired_return"]) == (step, 30.0 - step)
        socket.send_json(
            {"do": "change", "desired_return": 90.0, "desired_horizon": 70, "temperature": 0.0}
        )
        changed = next(seen)
        assert (changed["desired_return"], changed["desired_horizon"]) == (90.0, 70)
        assert (changed["step"], changed["is_changed"], changed["temperature"]) == (2, True, 0.0)
        socket.send_json({"do": "pause", "paused": False})
        last = ending(socket)
        assert last["is_changed"]
        assert last["desired_return"] == 90.0 - (last["step"] - 2)


def test_speed_changes_no_episode_and_delays_no_request(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("udrl_board.stage.fps_of", lambda env: 1 / 16)
    with client.websocket_connect("/stage") as socket:
        socket.send_json(start())
        assert next(moments(socket))["step"] == 0
        # The next step is due in 16 seconds.
        socket.send_json({"do": "pause", "paused": True})
        assert next(moments(socket))["step"] <= 1
        monkeypatch.setattr("udrl_board.stage.fps_of", lambda env: 50.0)
        obtained = []
        for speed in (4, 64):
            socket.send_json({"do": "speed", "speed": speed})
            socket.send_json(start())
            obtained.append(ending(socket)["obtained"])
        assert obtained[0] == obtained[1]


def test_checkpoint_of_the_run_can_be_selected(client: TestClient, ended_run: Path) -> None:
    kept = client.get("/news").json()["contents"]["versions"]
    assert len(kept) > 1
    with client.websocket_connect("/stage") as socket:
        socket.send_json(start(version=kept[0], paused=True))
        assert next(moments(socket))["version"] == kept[0]
        socket.send_json(start(version=10**9, paused=True))
        assert "not kept" in next(moments(socket))["problem"]
        socket.send_json(start(paused=True))
        assert next(moments(socket))["version"] == max(kept)


@pytest.mark.parametrize(
    "request_",
    ["", "[]", '{"do": "fly"}', '{"do": "start"}', json.dumps(start(desired_return="much")),
     json.dumps(start(seed=-1)), json.dumps(start(temperature=-1.0)),
     json.dumps(start(surplus=1, desired_horizon=2**40)),
     '{"do": "step", "surplus": ' + 4000 * "["],
)  # fmt: skip
def test_invalid_requests_are_reported(client: TestClient, request_: str) -> None:
    with client.websocket_connect("/stage") as socket:
        socket.send_text(request_)
        assert "invalid request" in socket.receive_json()["problem"]
        socket.send_json(start(paused=True))
        assert next(moments(socket))["step"] == 0


def test_requests_before_an_episode_have_no_effect(client: TestClient) -> None:
    with client.websocket_connect("/stage") as socket:
        for request in (
            {"do": "step"},
            {"do": "pause", "paused": True},
            {"do": "speed", "speed": 2},
        ):
            socket.send_json(request)
        socket.send_json(start(paused=True))
        assert next(moments(socket))["step"] == 0


def test_disconnecting_during_many_requests_frees_the_stage(client: TestClient) -> None:
    with client.websocket_connect("/stage") as socket:
        for _ in range(300):
            socket.send_json(start())
    assert client.get("/news").status_code == 200
    with client.websocket_connect("/stage") as socket:
        socket.send_json(start(paused=True))
        assert next(moments(socket))["step"] == 0


def test_rejected_request_does_not_end_the_episode(client: TestClient) -> None:
    with client.websocket_connect("/stage") as socket:
        seen = moments(socket)
        socket.send_json(start(paused=True))
        next(seen)
        socket.send_json({"do": "change", "desired_return": 1e12, "desired_horizon": 1})
        assert next(seen)["is_over"] is False
        socket.send_json({"do": "step"})
        assert next(seen)["step"] == 1


def test_exception_while_rendering_is_reported(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(rollout: object) -> None:
        raise ZeroDivisionError("no light")

    monkeypatch.setattr("udrl.rollout.Rollout.picture", broken)
    with client.websocket_connect("/stage") as socket:
        socket.send_json(start())
        trouble = next(moments(socket))
        assert "no light" in trouble["problem"]
        assert trouble["is_over"]


def test_episode_can_start_after_a_failure(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    with client.websocket_connect("/stage") as socket:
        with monkeypatch.context() as patch:
            patch.setattr("udrl.rollout.Rollout.picture", lambda rollout: 1 / 0)
            socket.send_json(start())
            assert next(moments(socket))["is_over"]
        socket.send_json(start())
        assert ending(socket)["over"]


def test_fields_missing_in_a_change_stay_unchanged(client: TestClient) -> None:
    with client.websocket_connect("/stage") as socket:
        socket.send_json(start(paused=True, desired_return=33.0, desired_horizon=44))
        next(moments(socket))
        socket.send_json({"do": "change", "temperature": 0.0})
        moment = next(moments(socket))
        command = [moment["desired_return"], moment["desired_horizon"], moment["temperature"]]
        assert command == [33.0, 44, 0.0]
        assert moment["is_changed"]


def test_idle_stage_is_closed(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    with client.websocket_connect("/stage") as socket:
        socket.send_json(start(paused=True))
        next(moments(socket))
        monkeypatch.setattr(board, "IDLE_S", 0.05)
        socket.send_json({"do": "step"})
        next(moments(socket))
        with pytest.raises(WebSocketDisconnect) as left:
            socket.receive_json()
        assert "without a request" in left.value.reason


def test_number_of_stages_is_limited(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(board, "MOST_STAGES", 1)
    with client.websocket_connect("/stage") as first:
        first.send_json(start(paused=True))
        next(moments(first))
        with client.websocket_connect("/stage") as second:
            assert "try again later" in second.receive_json()["problem"]

    def is_accepted() -> bool:
        with client.websocket_connect("/stage") as third:
            third.send_json(start(paused=True))
            return next(moments(third)).get("step") == 0

    wait_for(is_accepted, "the first stage to end")  # its thread closes the environment


def test_stage_counts_while_it_creates_an_environment_for_a_viewer_that_left(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(board, "MOST_STAGES", 1)
    creating, left, created = threading.Event(), threading.Event(), threading.Event()
    make, close = stage._make, Stage.close

    def make_slowly(hello: Hello) -> Any:
        creating.set()
        assert created.wait(60)
        return make(hello)

    def note_closing(one: Stage) -> None:
        close(one)
        left.set()

    monkeypatch.setattr(stage, "_make", make_slowly)
    monkeypatch.setattr(Stage, "close", note_closing)

    def visit() -> None:
        with client.websocket_connect("/stage") as socket:
            socket.send_json(start())
            assert creating.wait(60)

    viewer = threading.Thread(target=visit)
    viewer.start()
    assert left.wait(60)
    with client.websocket_connect("/stage") as second:
        second.send_json({"do": "nothing"})
        problem = second.receive_json()["problem"]
        created.set()
    viewer.join()
    assert "try again later" in problem
    with client.websocket_connect("/stage") as third:
        third.send_json(start(paused=True))
        assert next(moments(third))["step"] == 0


def test_environment_without_rendering_is_played(
    run: Callable[..., Status], tmp_path: Path
) -> None:
    from whole_run import toy

    run(toy(), 200, run_dir=tmp_path / "toy")
    with page(tmp_path / "toy") as client, client.websocket_connect("/stage") as socket:
        socket.send_json(start(desired_return=1.0, desired_horizon=1, temperature=0.0))
        last = ending(socket)
        assert last["picture"] is False
        assert last["step"] in (1, 2)


def test_actions_with_several_components(run: Callable[..., Status], tmp_path: Path) -> None:
    run(build(Config, SETTINGS), 400, run_dir=tmp_path / "nested")
    with page(tmp_path / "nested") as client, client.websocket_connect("/stage") as socket:
        socket.send_json(start(desired_horizon=8))
        first = next(moments(socket))
        components = {one["name"]: one["values"] for one in first["actions"]}
        assert components["door"] == ["1", "2", "3"]
        assert components["hands[1]"] == ["off", "on"]
        assert components["legs[0]"][0] == "-1"
        assert len(first["probabilities"]) == sum(map(len, components.values()))
        last = ending(socket)
        assert len(last["action"]) == len(components)
        assert last["actions"] is None


# Behind a proxy.

HUB, UNDER = "https://hub.example", "/user/board"


class Proxy:
    """Serves a board under a path of another host, as a reverse proxy does."""

    def __init__(self, board: ASGIApp, host: str) -> None:
        self._board = board
        self._host = host.encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "lifespan":
            assert scope["path"].startswith(UNDER), "link outside of the board's path"
            path = scope["path"].removeprefix(UNDER)
            headers = [(k, self._host if k == b"host" else v) for k, v in scope["headers"]]
            scope = dict(scope) | {"path": path, "raw_path": path.encode(), "headers": headers}
        await self._board(scope, receive, send)


@pytest.mark.parametrize("host", ["127.0.0.1:8765", "hub.example"])
def test_board_works_under_a_path_of_a_proxy(ended_run: Path, host: str) -> None:
    board = make_app(
        Feed(Directory(ended_run)), hosts=("127.0.0.1", "hub.example"), token="t", origins=(HUB,)
    )
    own = {"origin": HUB}
    with TestClient(Proxy(board, host), base_url=HUB) as client:
        assert client.get(f"{UNDER}/").status_code == 401
        main = client.get(f"{UNDER}/", params={"token": "t"})
        assert main.url == f"{HUB}{UNDER}/"
        assert "<title>udrl board</title>" in main.text
        (cookie,) = client.cookies.jar
        assert cookie.path == UNDER, "other pages behind the proxy must not get it"
        for part in re.findall(r'(?:src|href)="([^"#]+)"', main.text):
            assert client.get(main.url.join(part), headers=own).status_code == 200
        assert client.get(main.url.join("news"), headers=own).status_code == 200
        stage = str(main.url.join("stage")).replace("https", "wss")
        with client.websocket_connect(stage, headers=own) as socket:
            socket.send_json(start(paused=True))
            assert next(moments(socket))["step"] == 0
        strange = client.get(f"{UNDER}/news", headers={"origin": "https://evil.example"})
        assert strange.status_code == 403
        assert "--allow-origin https://evil.example" in strange.text


def test_page_of_an_unknown_proxy_explains_how_to_allow_it(ended_run: Path) -> None:
    board = make_app(Feed(Directory(ended_run)))
    with TestClient(Proxy(board, "127.0.0.1"), base_url=HUB) as client:
        answer = client.get(f"{UNDER}/news", headers={"origin": HUB})
    assert answer.status_code == 403
    assert "start `udrl board` with --allow-origin https://hub.example" in answer.text


# The command.


def test_command_rejects_invalid_arguments(tmp_path: Path, ended_run: Path) -> None:
    def call(*words: object) -> None:
        CliRunner().invoke(
            command, list(map(str, words)), standalone_mode=False, catch_exceptions=False
        )

    with pytest.raises(ConfigError, match="give either RUN_DIR or --connect"):
        call()
    with pytest.raises(StoreError, match="holds no run"):
        call(tmp_path)
    with pytest.raises(Unreachable):
        call("--connect", f"tcp/127.0.0.1:{free_port()}")
    for host in ("203.0.113.7", "a..b"):
        with pytest.raises(ConfigError, match="choose an address of this machine"):
            call(ended_run, "--host", host)
    with pytest.raises(ConfigError, match="letters, digits"):
        call(ended_run, "--token", "a+b&c")
    for origin in ("hub.example", "https://hub.example/", "https://Hub.example", "*", "null"):
        with pytest.raises(
            ConfigError, match=r"--allow-origin .*: expected scheme, host and optional port"
        ):
            call(ended_run, "--allow-origin", origin)


def test_listening_beyond_loopback_creates_a_token(
    cli: Callable[..., Cli], ended_run: Path
) -> None:
    process = cli("board", str(ended_run), "--host", "0.0.0.0").process
    assert process.stdout is not None
    line = process.stdout.readline()
    # By a name that other machines may use, unlike 0.0.0.0.
    assert line.startswith(f"board: http://{socket.gethostname()}:")
    assert len(line.split("?token=")[1].strip()) >= 20
    process.terminate()
    assert process.wait(20) == 128 + signal.SIGTERM
