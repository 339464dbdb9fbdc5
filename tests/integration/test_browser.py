"""The board in a real browser: live runs, commands, accessibility."""

import os
import re
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgspec
import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Page, expect, sync_playwright

from test_spaces import SETTINGS
from test_take_cover import TAKE_COVER
from udrl.config import Budget, Config, build
from udrl.errors import RunFailed
from udrl_inspect.agents import evaluate, evaluation_commands, load_agent
from udrl_inspect.inspection import read_status
from udrl_inspect.obedience_report import measure, plan_commands, save_report
from udrl_inspect.obedience_text import summary
from udrl_launch.settings import Fleet, Settings
from udrl_launch.training_run import run_training
from udrl_proto.reports import Status
from udrl_replay.progress import RunProgress
from udrl_replay.store import Store
from udrl_show.playing import with_seeds
from whole_run import (
    LANDER,
    OBEDIENT,
    SMALL,
    Cli,
    arguments,
    free_port,
    live_status,
    small,
    wait_for,
)

pytestmark = [pytest.mark.browser, pytest.mark.timeout(300)]

#: Disables Chromium's own connections.
_ALONE = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update",
]  # fmt: skip
#: Timeout in milliseconds, for slow machines.
SOON = 20_000


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    path = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("no Chromium found; set the environment variable CHROMIUM")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=_ALONE)
        yield browser
        browser.close()


@pytest.fixture
def pages(browser: Browser) -> Iterator[Callable[..., Page]]:
    """Open pages that may connect to loopback only, and must not raise errors."""
    wrong: list[str] = []
    contexts = []

    def watch(url: str) -> None:
        if urlsplit(url).hostname not in ("127.0.0.1", None):
            wrong.append(f"requested {url}")

    def start(url: str, **options: Any) -> Page:
        contexts.append(browser.new_context(**options))
        page = contexts[-1].new_page()
        page.on("request", lambda request: watch(request.url))
        page.on("websocket", lambda socket: watch(socket.url))
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.goto(url)
        return page

    yield start
    for context in contexts:
        context.close()
    assert wrong == []


@pytest.fixture(scope="module")
def obedient(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run_dir = tmp_path_factory.mktemp("obedient") / "run"
    settings = Settings(
        build(Config, OBEDIENT), Budget(max_env_steps=1280), Fleet(actors=1, envs_per_actor=8)
    )
    run_training(settings, run_dir, threading.Event(), in_process=True)
    return run_dir


@pytest.fixture
def board(cli: Callable[..., Cli]) -> Callable[..., str]:
    def start(*words: object) -> str:
        process = cli("board", *map(str, words)).process
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("board: "), line
        return line.split()[1]

    return start


@contextmanager
def edited_progress(run_dir: Path) -> Iterator[RunProgress]:
    """Write a run's progress again after the block."""
    with closing(Store(run_dir)) as store, store.transaction():
        yield (progress := store.fact("progress", RunProgress))
        store.set_fact("progress", progress)


#: Slow enough that an episode is not over before a click arrives.
PAUSE_AT_ONCE = """() => {
    const button = document.getElementById("pause");
    new MutationObserver((_, observer) => {
        if (!button.disabled) { observer.disconnect(); button.click(); }
    }).observe(button, {attributes: true});
}"""


def start(page: Page, desired_return: float, horizon: int = 4, seed: int = 1) -> None:
    page.get_by_label("Desired return", exact=True).fill(str(desired_return))
    page.get_by_label("Desired horizon, steps", exact=True).fill(str(horizon))
    page.get_by_label("Seed").fill(str(seed))
    page.get_by_role("button", name="Start episode").click()


def fact(page: Page, name: str, facts: str = "#moment") -> Any:
    """Return the value of a named number."""
    return page.locator(f"{facts} div").filter(has=page.get_by_text(name, exact=True)).locator("dd")


def rows(page: Page) -> Any:
    return page.locator("#episodes tbody tr")


def test_live_run_appears_and_its_curve_grows(
    cli: Callable[..., Cli], board: Callable[..., str], pages: Callable[..., Page], tmp_path: Path
) -> None:
    endpoint, run_dir = f"tcp/127.0.0.1:{free_port()}", tmp_path / "run"
    cli(*arguments(SMALL, 10_000_000, run_dir), "--listen", endpoint, "--actors", "1")
    wait_for(lambda: (s := live_status(run_dir)) and s.iteration > 2, "some iterations")
    url = board("--connect", endpoint)
    page = pages(url)
    other = pages(url)
    for one in (page, other):
        expect(one.get_by_role("status").first).to_have_text("Running", timeout=SOON)
        expect(one.locator("#curve canvas")).to_be_visible(timeout=SOON)
        expect(one.locator("#actor-table tbody tr")).to_have_count(1)
        assert one.locator("#details").get_attribute("open") is None
        heads = one.locator("#actor-table th").all_text_contents()
        cells = one.locator("#actor-table tbody td").all_text_contents()
        shown = dict(zip(heads, cells, strict=True))
        assert (shown["reruns"], shown["failures"], shown["environments"]) == ("0", "0", "16")
    for _ in range(3):
        points = page.locator("#curve").get_attribute("data-points")
        grown = page.locator(f'#curve[data-points]:not([data-points="{points}"])')
        expect(grown).to_be_visible(timeout=SOON)
        now = page.locator("#curve").get_attribute("data-points")
        assert int(now or 0) > int(points or 0) > 0
    expect(page.locator("#buffer circle").first).to_be_visible()
    expect(page.locator("#buffer .explored").first).to_be_visible()
    zoomed = read_after_zooming(page)
    points = page.locator("#curve").get_attribute("data-points")
    page.mouse.move(0, 0)
    expect(page.locator(f'#curve:not([data-points="{points}"])')).to_be_visible(timeout=SOON)
    assert read_at_the_end(page) == zoomed
    page.get_by_role("button", name="Reset zoom").click()
    assert read_at_the_end(page) != zoomed
    expect(page.get_by_role("button", name="Reset zoom")).to_be_hidden()


def read_at_the_end(page: Page) -> str:
    """Return the cursor's reading at the right end of the curve."""
    page.locator("#curve").scroll_into_view_if_needed()
    box = page.locator("#curve .u-over").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + box["width"] - 1, box["y"] + 20)
    return page.locator("#curve-said").inner_text().split(":")[0]


def read_after_zooming(page: Page) -> str:
    """Zoom into the middle of the curve; return the cursor's reading at its new right end."""
    before = read_at_the_end(page)
    box = page.locator("#curve .u-over").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 50)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.6 * box["width"], box["y"] + 50, steps=5)
    page.mouse.up()
    after = read_at_the_end(page)
    assert after != before
    return after


def test_given_command_is_obeyed(
    board: Callable[..., str], pages: Callable[..., Page], obedient: Path
) -> None:
    page = pages(board(obedient))
    expect(page.get_by_label("Desired return", exact=True)).not_to_be_empty(timeout=SOON)
    page.get_by_label("Greedy").check()
    for number, commanded in enumerate((3, 1, 4, 0, 2), start=1):
        start(page, commanded)
        expect(rows(page)).to_have_count(number, timeout=SOON)
        cells = rows(page).first.locator("td").all_text_contents()
        assert cells[:4] == [str(commanded), str(commanded), "4", "4"]
        expect(page.locator("#outcome")).to_have_text(
            f"Commanded {commanded} in 4 steps; obtained {commanded} in 4 steps."
        )
        expect(page.locator("#obeyed circle")).to_have_count(number)
    expect(page.locator("#no-picture")).to_contain_text("cannot be rendered")


@pytest.mark.parametrize("temperature", [0.0, 0.01])
def test_episode_is_that_of_play_with_the_temperature_of_evaluations(
    temperature: float, board: Callable[..., str], pages: Callable[..., Page],
    run: Callable[..., Status], tmp_path: Path,
) -> None:  # fmt: skip
    run(small(eval_temperature=temperature), 2000, run_dir=tmp_path / "run")
    agent = load_agent(tmp_path / "run")
    commands = evaluation_commands(agent, episodes=1, desired_return=60, desired_horizon=60)
    (played,) = evaluate(agent, with_seeds(commands, 10)).returns
    page = pages(board(tmp_path / "run"))
    expect(page.get_by_label("Desired return", exact=True)).not_to_be_empty(timeout=SOON)
    assert page.get_by_label("Greedy").is_checked() == (temperature == 0)
    page.get_by_label("Speed", exact=True).select_option("16")
    start(page, 60, 60, seed=10)
    expect(rows(page)).to_have_count(1, timeout=SOON)
    assert rows(page).first.locator("td").all_text_contents()[1] == f"{played:g}"


def test_keyboard_operation(
    board: Callable[..., str], pages: Callable[..., Page], obedient: Path
) -> None:
    page = pages(board(obedient))
    expect(page.get_by_label("Desired return", exact=True)).not_to_be_empty(timeout=SOON)

    def focused() -> str:
        return str(page.evaluate("document.activeElement.id"))

    def tab_to(name: str) -> None:
        for _ in range(40):
            page.keyboard.press("Tab")
            if focused() == name:
                return
        raise AssertionError(f"the Tab key does not lead to {name}")

    def type_into(name: str, text: str) -> None:
        tab_to(name)
        page.keyboard.press("Control+A")
        page.keyboard.type(text)

    page.keyboard.press("Tab")
    page.keyboard.press("Enter")  # skip to the command
    tab_to("desired-return-slider")
    before = page.locator("#desired-return").input_value()
    page.keyboard.press("ArrowLeft")
    assert page.locator("#desired-return").input_value() != before
    type_into("desired-return", "2")
    type_into("desired-horizon", "4")
    tab_to("greedy")
    page.keyboard.press("Space")
    tab_to("start")
    page.keyboard.press("Enter")
    expect(rows(page)).to_have_count(1, timeout=SOON)
    assert rows(page).first.locator("td").all_text_contents()[1] == "2"


def test_command_is_changed_during_the_episode(
    board: Callable[..., str], pages: Callable[..., Page], ended_run: Path
) -> None:
    page = pages(board(ended_run))
    expect(page.get_by_label("Desired return", exact=True)).not_to_be_empty(timeout=SOON)
    page.evaluate(PAUSE_AT_ONCE)
    start(page, 400, 400)
    expect(page.get_by_role("button", name="Resume")).to_be_visible(timeout=SOON)
    step, change = fact(page, "step"), page.get_by_role("button", name="Change command")
    expect(page.locator(".primary")).to_have_text("Resume")
    at = int(step.inner_text())
    page.get_by_role("button", name="Step").click()
    expect(step).to_have_text(str(at + 1))
    page.get_by_label("Desired return", exact=True).fill("77")
    expect(page.locator(".primary")).to_have_text("Change command")
    change.click()
    expect(fact(page, "desired return now")).to_have_text("77")
    expect(page.locator(".primary")).to_have_text("Resume")
    expect(page.locator("#picture")).to_be_visible()
    # Enter in a field changes the command too, without starting another episode.
    page.get_by_label("Desired horizon, steps", exact=True).fill("55")
    page.keyboard.press("Enter")
    expect(fact(page, "desired horizon now")).to_have_text("55 steps")
    expect(page.locator("#map .active")).to_have_count(1)
    # Invalid numbers have no effect, nor has another temperature.
    page.get_by_label("Desired return", exact=True).fill("")
    change.click()
    page.get_by_label("Greedy").check()
    page.get_by_role("button", name="Step").click()
    expect(step).to_have_text(str(at + 2))
    expect(fact(page, "desired return now")).to_have_text("76")
    page.get_by_role("button", name="Resume").click()
    expect(rows(page)).to_have_count(1, timeout=SOON)
    expect(rows(page).first).to_contain_text("greedy, command changed")
    expect(page.locator("#map .active")).to_have_count(0)


@pytest.mark.parametrize("settings", [LANDER | {"max_episode_steps": 120}, TAKE_COVER])
def test_environment_is_shown(
    settings: dict[str, Any], board: Callable[..., str], pages: Callable[..., Page],
    run: Callable[..., Status], tmp_path: Path,
) -> None:  # fmt: skip
    run(build(Config, settings), 3000, run_dir=tmp_path / "run")
    page = pages(board(tmp_path / "run"))
    returns = page.get_by_label("Desired return", exact=True)
    expect(returns).not_to_be_empty(timeout=SOON)
    horizon = page.get_by_label("Desired horizon, steps", exact=True)
    follows = settings.get("horizon_equals_return", False)
    returns.fill("60.5")
    if follows:  # TakeCover's horizon is its return
        expect(horizon).to_be_disabled()
        expect(horizon).to_have_value("60")
    else:
        horizon.fill("60")
    page.get_by_role("button", name="Start episode").click()
    picture = page.locator("#picture")
    expect(picture).to_be_visible(timeout=SOON)
    expect(rows(page)).to_have_count(1, timeout=60_000)
    width, height = picture.evaluate("image => [image.naturalWidth, image.naturalHeight]")
    assert width > 100
    assert height > 100


def test_map_sets_the_command_and_shows_whether_similar_episodes_exist(
    board: Callable[..., str], pages: Callable[..., Page], ended_run: Path
) -> None:
    url = board(ended_run)
    page = pages(url)
    expect(page.locator("#map .unseen").first).to_be_visible(timeout=SOON)
    seen = page.request.get(f"{url}news").json()["contents"]
    page.get_by_label("Desired return", exact=True).fill(str(seen["returns"][0]))
    page.get_by_label("Desired horizon, steps", exact=True).fill(str(seen["lengths"][0]))
    expect(page.locator("#similar")).to_have_text("The buffer has similar episodes.")
    box = page.locator("#map svg").bounding_box()
    assert box is not None
    page.mouse.click(box["x"] + 0.15 * box["width"], box["y"] + 0.1 * box["height"])
    expect(page.locator("#similar")).to_contain_text("No similar episodes")
    chosen = [
        float(page.locator(f"#desired-{what}").input_value()) for what in ("return", "horizon")
    ]
    # On CartPole, returns equal lengths: few points of the plane are possible.
    assert chosen[0] < chosen[1]
    expect(page.locator("#map .chosen.outside")).to_have_count(0)
    page.get_by_label("Desired return", exact=True).fill("100000")
    expect(page.locator("#similar")).to_contain_text("This command is outside the map.")
    expect(page.locator("#map .chosen.outside")).to_have_count(1)


def test_map_shows_the_obeyed_returns(
    board: Callable[..., str], pages: Callable[..., Page], obedient: Path, tmp_path: Path
) -> None:
    run_dir = Path(shutil.copytree(obedient, tmp_path / "run"))
    page = pages(board(run_dir))
    caption, shaded = page.locator("#obeys"), page.locator("#map rect.obeys")
    expect(caption).to_contain_text(f"udrl obedience {run_dir}", timeout=SOON)
    expect(shaded).to_have_count(0)
    agent = load_agent(run_dir)
    report = measure(agent, plan_commands(agent, points=5, episodes=20, temperature=0.0))
    save_report(run_dir, report)
    expect(caption).to_have_text(summary(report), timeout=SOON)
    expect(caption).to_contain_text("You can command returns from 0 to 4")
    expect(shaded).to_have_count(1)
    left, right = shaded.bounding_box(), page.locator("#map svg").bounding_box()
    assert left is not None
    assert right is not None
    assert 0.5 * right["width"] < left["width"] < right["width"]
    latest = report.weights_version
    save_report(run_dir, msgspec.structs.replace(report, weights_version=latest - 1, obeyed=None))
    expect(caption).to_contain_text(
        f"Measured with weights version {latest - 1}; the latest is {latest}.", timeout=SOON
    )
    expect(shaded).to_have_count(0)


def test_page_reconnects_to_a_restarted_server(
    cli: Callable[..., Cli], pages: Callable[..., Page], obedient: Path
) -> None:
    port = str(free_port())
    first = cli("board", str(obedient), "--port", port).process
    assert first.stdout is not None
    page = pages(first.stdout.readline().split()[1])
    expect(page.get_by_label("Desired return", exact=True)).not_to_be_empty(timeout=SOON)
    start(page, 1)
    expect(rows(page)).to_have_count(1, timeout=SOON)
    first.kill()
    expect(page.get_by_role("alert")).to_contain_text("does not reply", timeout=SOON)
    second = cli("board", str(obedient), "--port", port).process
    assert second.stdout is not None
    assert second.stdout.readline()
    expect(page.get_by_role("alert")).to_be_hidden(timeout=SOON)
    start(page, 1)
    expect(rows(page)).to_have_count(2, timeout=SOON)


def test_cursor_reads_the_curve(
    board: Callable[..., str], pages: Callable[..., Page], ended_run: Path
) -> None:
    page = pages(board(ended_run))
    caption, curve = page.locator("#curve-said"), page.locator("#curve .u-over")
    final = read_status(ended_run).final_evaluation
    assert final is not None
    expect(caption).to_contain_text("best evaluation", timeout=SOON)
    summary = caption.inner_text()
    best = re.search(r"best evaluation (\S+ ± \S+) after", summary)
    assert best is not None
    expect(page.locator("#facts")).to_contain_text(f"best evaluation{best[1]}")  # the same one
    box = curve.bounding_box()
    assert box is not None
    curve.hover(position={"x": box["width"] - 2, "y": 20})
    expect(caption).to_contain_text(f"final evaluation {final.mean:,.1f}".removesuffix(".0"))
    page.mouse.move(0, 0)
    expect(caption).to_have_text(summary)


def test_failed_run_shows_the_reason_and_how_to_resume(
    board: Callable[..., str], pages: Callable[..., Page], run: Callable[..., Status],
    tmp_path: Path,
) -> None:  # fmt: skip
    run_dir = tmp_path / "cursed"
    with pytest.raises(RunFailed):
        run(small(environment="flaky_environments:Cursed-v0"), 2000, run_dir=run_dir)
    page = pages(board(run_dir))
    expect(page.get_by_role("status").first).to_have_text("Failed", timeout=SOON)
    expect(page.get_by_role("alert")).to_contain_text("reproduce it with: udrl reproduce")
    again = f"udrl train flaky_environments:Cursed-v0 --run-dir {run_dir} --resume"
    expect(page.locator("#next")).to_contain_text(f"Fix the cause, then resume the run: {again}")


def test_stopped_run_shows_how_to_resume(
    cli: Callable[..., Cli], board: Callable[..., str], pages: Callable[..., Page], tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    process = cli(*arguments(SMALL, 10_000_000, run_dir), "--actors", "1")
    wait_for(lambda: (s := live_status(run_dir)) and s.iteration > 2, "some iterations")
    page = pages(board(run_dir))
    expect(page.get_by_role("status").first).to_contain_text("Running", timeout=SOON)
    process.process.send_signal(signal.SIGINT)
    process.finish()
    expect(page.get_by_role("status").first).to_contain_text("Stopped", timeout=SOON)
    expect(page.locator("#next")).to_have_text(
        "No process is running this run. Resume it: "
        f"udrl train CartPole-v1 --run-dir {run_dir} --resume"
    )
    expect(page.get_by_role("alert")).to_be_hidden()


@pytest.mark.parametrize(
    ("stop_return", "limit"), [("0.0", "--stop-return"), ('"unset"', "--max-env-steps")]
)
def test_ended_run_shows_the_limit_that_continues_it(
    stop_return: str, limit: str, board: Callable[..., str], pages: Callable[..., Page],
    ended_run: Path, tmp_path: Path,
) -> None:  # fmt: skip
    run_dir = tmp_path / "run"
    shutil.copytree(ended_run, run_dir)
    with closing(Store(run_dir)) as store, store.transaction():
        final = store.last_evaluation(is_final=True)
        assert final is not None
        store.add_evaluation(final._replace(is_final=False))
    config = run_dir / "config.toml"
    lines = [s for s in config.read_text().splitlines() if not s.startswith("stop_return")]
    config.write_text("\n".join([*lines, f"stop_return = {stop_return}"]))
    page = pages(board(run_dir))
    again = f"udrl train CartPole-v1 --run-dir {run_dir} --resume {limit} MORE"
    expect(page.locator("#next")).to_have_text(f"Continue training: {again}", timeout=SOON)


def test_run_with_a_false_episode_does_not_suggest_to_resume_it(
    board: Callable[..., str], pages: Callable[..., Page], ended_run: Path, tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    shutil.copytree(ended_run, run_dir)
    problem = "actor a delivered a false episode"
    with edited_progress(run_dir) as progress:
        progress.state, progress.deceived, progress.problem = "failed", True, problem
    page = pages(board(run_dir))
    expect(page.get_by_role("alert")).to_contain_text(problem, timeout=SOON)
    expect(page.locator("#next")).to_be_hidden()


def test_several_runs_are_compared(
    board: Callable[..., str], pages: Callable[..., Page], ended_run: Path, obedient: Path
) -> None:
    page = pages(board(ended_run, obedient))
    runs = page.locator("#run-table tbody tr")
    expect(runs).to_have_count(2, timeout=SOON)
    assert runs.nth(1).locator("td").all_text_contents()[1:3] == ["Obedience-v0", "Ended"]
    expect(page.locator("#all canvas")).to_be_visible()
    expect(page.locator("#all-legend [stroke-dasharray]")).to_have_count(0)
    expect(page.locator("#title")).to_have_text("CartPole-v1")
    runs.nth(1).get_by_role("link").click()
    expect(page.locator("#title")).to_have_text("Obedience-v0", timeout=SOON)
    expect(page.get_by_label("Desired return", exact=True)).not_to_be_empty(timeout=SOON)
    start(page, 3)
    expect(rows(page)).to_have_count(1, timeout=SOON)
    expect(page.locator("#no-picture")).to_contain_text("cannot be rendered")


def test_numbers_round_to_zero_without_a_sign(
    obedient: Path, board: Callable[..., str], pages: Callable[..., Page]
) -> None:
    page = pages(board(obedient))
    shown = page.evaluate(
        """async () => {
            const { evaluated, number } = await import("./format.js");
            const evaluation = { mean: -0.01, ci95_low: -1.5, ci95_high: 1.5 };
            return [number(-0.04, 1), number(-0.06, 1), number(-0), evaluated(evaluation)];
        }"""
    )
    assert shown == ["0.0", "-0.1", "0", "0.0 ± 1.5"]


def test_labels_of_an_axis_differ(
    obedient: Path, board: Callable[..., str], pages: Callable[..., Page]
) -> None:
    page = pages(board(obedient))
    shown = page.evaluate(
        """async () => {
            const { labels } = await import("./format.js");
            return [labels([0, 1e-5, 2e-5]), labels([0, 0.5, 1]), labels([0, 1e6, 2.5e6])];
        }"""
    )
    assert shown == [["0", "0.00001", "0.00002"], ["0", "0.5", "1.0"], ["0", "1.0M", "2.5M"]]


def test_endpoint_in_a_command_is_quoted_if_a_shell_would_expand_it(
    obedient: Path, board: Callable[..., str], pages: Callable[..., Page]
) -> None:
    page = pages(board(obedient))
    shown = page.evaluate(
        """async () => {
            const { commands } = await import("./run.js");
            const status = { environment: "CartPole-v1" };
            const of = (endpoint) => commands({ place: { run_dir: "", endpoint }, status });
            return ["tcp/[::1]:7447", "tcp/a:7447"].map((at) => of(at).service("actor"));
        }"""
    )
    assert shown == [
        "udrl actor --connect 'tcp/[::1]:7447'",
        "udrl actor --connect tcp/a:7447",
    ]


def test_quarantined_actors_are_listed(
    board: Callable[..., str], pages: Callable[..., Page], ended_run: Path, tmp_path: Path
) -> None:
    run_dir = tmp_path / "run"
    shutil.copytree(ended_run, run_dir)
    with closing(Store(run_dir)) as store, store.transaction():
        store.set_fact("quarantined", {"actor-9": "<b>ten invalid episodes</b>"})
    page = pages(board(run_dir))
    expect(page.get_by_label("Quarantined actors")).to_have_text(
        "quarantined: actor-9: <b>ten invalid episodes</b>", timeout=SOON
    )


def test_presets_are_commands_from_the_buffer(
    board: Callable[..., str], pages: Callable[..., Page], ended_run: Path
) -> None:
    url = board(ended_run)
    page = pages(url)
    buttons = page.locator("#presets button")
    expect(buttons).to_have_text(["Best", "Longest", "Worst and quick"], timeout=SOON)
    seen = page.request.get(f"{url}news").json()["contents"]
    field = page.get_by_label("Desired return", exact=True)
    expected = (seen["desired_return"], max(seen["returns"]))
    for button, wanted in zip(("Best", "Longest"), expected, strict=True):
        page.get_by_role("button", name=button, exact=True).click()
        assert float(field.input_value()) == pytest.approx(wanted, abs=0.051)
    page.get_by_role("button", name="Worst and quick").click()
    lowest = sorted(seen["returns"])
    assert float(field.input_value()) <= lowest[round(0.1 * (len(lowest) - 1))]


def test_actions_of_several_components_have_names(
    board: Callable[..., str], pages: Callable[..., Page], run: Callable[..., Status],
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    run(build(Config, SETTINGS | {"action_bins": 9}), 400, run_dir=tmp_path / "nested")
    page = pages(board(tmp_path / "nested"))
    expect(page.get_by_label("Desired return", exact=True)).not_to_be_empty(timeout=SOON)
    page.evaluate(PAUSE_AT_ONCE)
    start(page, 3, 8)
    expect(page.get_by_role("button", name="Resume")).to_be_visible(timeout=SOON)
    bars = page.locator("#actions .bars")
    expect(bars).to_have_count(3)
    expect(bars.first.locator(".value")).to_have_text(["1", "2", "3"])
    shares = bars.first.locator(".share").all_text_contents()
    assert 98 <= sum(int(share.split()[0]) for share in shares) <= 102
    expect(bars.nth(2)).to_contain_text("hands[1]")
    histograms = page.locator("#actions .histogram")
    expect(histograms).to_have_count(2)
    expect(histograms.first.locator("rect")).to_have_count(9)
    expect(histograms.first).to_contain_text("legs[0]: most likely")
    page.get_by_role("button", name="Resume").click()
    expect(rows(page)).to_have_count(1, timeout=SOON)
    expect(fact(page, "last action")).to_have_text(re.compile(r"^[123](, (on|off)){2}(, \S+){2}$"))


def test_phone_layout_shows_frame_and_pause_together(
    board: Callable[..., str], pages: Callable[..., Page], ended_run: Path
) -> None:
    page = pages(board(ended_run), viewport={"width": 400, "height": 800})
    expect(page.get_by_label("Desired return", exact=True)).not_to_be_empty(timeout=SOON)
    start(page, 50, 50)
    expect(page.locator("#picture")).to_be_visible(timeout=SOON)
    page.evaluate("scrollTo(0, 0)")
    picture, pause = (page.locator(f"#{name}").bounding_box() for name in ("picture", "pause"))
    assert picture is not None
    assert pause is not None
    assert picture["y"] >= 0
    assert pause["y"] + pause["height"] <= 800


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [400, 1200])
def test_page_is_accessible_and_fits_the_window(
    board: Callable[..., str], pages: Callable[..., Page], ended_run: Path, scheme: str, width: int
) -> None:
    page = pages(
        board(ended_run), viewport={"width": width, "height": 800}, color_scheme=scheme,
        bypass_csp=True,  # injects the checker into the page
    )  # fmt: skip
    expect(page.locator("#curve canvas")).to_be_visible(timeout=SOON)
    start(page, 50, 50)
    expect(rows(page)).to_have_count(1, timeout=SOON)
    page.locator("#details summary").click()
    expect(page.locator("#loss canvas")).to_be_visible()
    found = Axe().run(page)
    assert found.violations_count == 0, found.generate_report()
    assert page.evaluate("document.documentElement.scrollWidth") <= width
