import itertools
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Annotation

from udrl.errors import ConfigError
from udrl_experiments.figures import learning_curves, save, sensitivity_figure
from udrl_experiments.records import Obtained
from udrl_experiments.statistics import CurvePoint

GREEN = "#009e73"


def curve(
    algorithm: str = "UDRL", variant: str = "", *, n: int = 5, seeds: int = 20
) -> list[CurvePoint]:
    return [
        CurvePoint(
            environment="LunarLander-v3", algorithm=algorithm, variant=variant,
            env_steps=50_000 * i, wall_s=90.0 * i, seeds=seeds, mean=10.0 * i, low=10.0 * i - 3,
            high=10.0 * i + 4,
        )
        for i in range(n)
    ]  # fmt: skip


def obtained(seed: int, returns: Sequence[float] = (0, 100, 200)) -> list[Obtained]:
    return [
        Obtained(
            environment="LunarLander-v3", seed=seed, env_steps=10_000_000, desired_return=desired,
            desired_horizon=300, mean=0.5 * desired + seed, std=50.0, episodes=100,
        )
        for desired in returns
    ]  # fmt: skip


def labelled(figure: Figure) -> dict[str, Line2D]:
    """The lines of the legend, by label."""
    (legend,), (axes,) = figure.legends, figure.axes
    handles, labels = axes.get_legend_handles_labels()
    assert sorted(labels) == sorted(text.get_text() for text in legend.get_texts())
    # The handle of a line with error bars is a container that begins with the line.
    lines = [handle[0] if isinstance(handle, ErrorbarContainer) else handle for handle in handles]
    return dict(zip(labels, lines, strict=True))


def data(line: Line2D) -> tuple[list[float], list[float]]:
    x, y = (np.asarray(values, dtype=np.float64) for values in line.get_data())
    return x.tolist(), y.tolist()


ALL = [*curve("DQN"), *curve("A2C"), *curve("PPO"), *curve("UDRL", "paper"), *curve("UDRL")]
MANY = [point for i in range(31) for point in curve("UDRL", f"lead {i}")]


def test_each_agent_has_a_line_with_its_seeds() -> None:
    points = [*curve(), *curve("UDRL", "lead 2", seeds=1), *curve("A2C", seeds=3)]
    figure = learning_curves(points, "LunarLander")
    lines = labelled(figure)
    assert list(lines) == ["UDRL (20 seeds)", "UDRL lead 2 (1 seed)", "A2C (3 seeds)"]
    (axes,) = figure.axes
    assert len(axes.lines) == 3
    assert axes.get_title() == "LunarLander"
    assert axes.get_xlabel() == "env steps (millions)"
    assert axes.get_ylabel() == "mean return"
    for line in lines.values():
        x, y = data(line)
        assert x == pytest.approx([0, 0.05, 0.1, 0.15, 0.2])
        assert y == [0, 10, 20, 30, 40]


def test_curve_over_wall_time() -> None:
    figure = learning_curves(curve(), "LunarLander", x="wall_s")
    assert figure.axes[0].get_xlabel() == "wall time (minutes)"
    x, _ = data(labelled(figure)["UDRL (20 seeds)"])
    assert x == [0, 1.5, 3, 4.5, 6]


@pytest.mark.parametrize(("n", "scale"), [(5, "linear"), (31, "log")])
def test_axis_is_logarithmic_if_one_line_is_much_longer(n: int, scale: str) -> None:
    points = [*curve("UDRL", n=5), *curve("DQN", n=n)]
    for x in ("env_steps", "wall_s"):
        (axes,) = learning_curves(points, "LunarLander", x=x).axes
        assert axes.get_xscale() == scale


def test_band_is_the_interval() -> None:
    (band,) = learning_curves(curve(n=3), "LunarLander").axes[0].collections
    corners = {(round(x, 9), y) for x, y in np.asarray(band.get_paths()[0].vertices)}
    assert corners == {(0, -3), (0, 4), (0.05, 7), (0.05, 14), (0.1, 17), (0.1, 24)}


def test_labels_name_environments_if_there_are_several() -> None:
    sparse = [msgspec.structs.replace(p, environment="LunarLanderSparse-v3") for p in curve()]
    assert list(labelled(learning_curves([*curve(), *sparse], "both"))) == [
        "LunarLander-v3 UDRL (20 seeds)",
        "LunarLanderSparse-v3 UDRL (20 seeds)",
    ]
    there = [msgspec.structs.replace(r, environment="LunarLanderSparse-v3") for r in obtained(1)]
    assert list(labelled(sensitivity_figure([*obtained(1), *there], "both")))[1:] == [
        "LunarLander-v3 seed 1",
        "LunarLanderSparse-v3 seed 1",
    ]


def test_references_are_labelled_lines() -> None:
    figure = learning_curves(curve(), "LunarLander", references={"lands": 100, "solved": 200})
    (axes,) = figure.axes
    names = [text for text in axes.texts if isinstance(text, Annotation)]
    assert [(name.get_text(), name.xy) for name in names] == [
        ("lands", (1, 100)),
        ("solved", (1, 200)),
    ]
    levels = [data(line)[1] for line in axes.lines if line.get_marker() == "None"]
    assert levels == [[100, 100], [200, 200]]
    assert axes.get_ylim()[1] > 200
    assert list(labelled(figure)) == ["UDRL (20 seeds)"]


@pytest.mark.parametrize(("lowest", "is_cut"), [(-300.0, True), (-1000.0, False)])
def test_very_low_returns_do_not_flatten_the_others(lowest: float, is_cut: bool) -> None:
    bad = [msgspec.structs.replace(p, mean=-500.0, low=-600.0, high=-400.0) for p in curve("DQN")]
    (axes,) = learning_curves([*curve(), *bad], "LunarLanderSparse", lowest=lowest).axes
    assert (axes.get_ylim()[0] == lowest) == is_cut
    assert (axes.get_ylabel() == "mean return (lower than -300: not shown)") == is_cut
    assert axes.get_ylim()[1] > 40


def test_algorithms_have_fixed_styles() -> None:
    def style(line: Line2D) -> tuple[str, object, object]:
        return to_hex(line.get_color()), line.get_linestyle(), line.get_marker()

    one = {label: style(line) for label, line in labelled(learning_curves(ALL, "")).items()}
    other = labelled(learning_curves(ALL[::-1], ""))
    assert one == {label: style(line) for label, line in other.items()}
    assert one["UDRL (20 seeds)"][0] == GREEN
    assert len({colour for colour, _, _ in one.values()}) == 5
    for algorithm, variant in (("DQN", ""), ("UDRL", "paper")):
        ((label, alone),) = labelled(learning_curves(curve(algorithm, variant), "")).items()
        assert style(alone) == one[label]


@pytest.mark.parametrize(
    "draw",
    [
        lambda: learning_curves(ALL, ""),
        lambda: learning_curves([*ALL, *MANY], ""),
        lambda: learning_curves(MANY, ""),
        lambda: sensitivity_figure([row for seed in range(1, 21) for row in obtained(seed)], ""),
    ],
)
def test_lines_differ_in_greyscale(draw: Callable[[], Figure]) -> None:
    lines = labelled(draw()).values()
    for one, other in itertools.combinations(lines, 2):
        assert (one.get_linestyle(), one.get_marker()) != (
            other.get_linestyle(),
            other.get_marker(),
        )


def test_every_line_shows_its_marker_at_any_length() -> None:
    for n in (1, 2, 9, 10, 11, 19, 20, 201):
        points = [point for i in range(12) for point in curve("UDRL", f"lead {i}", n=n)]
        for line in labelled(learning_curves(points, "")).values():
            every = line.get_markevery()
            assert isinstance(every, tuple)
            start, step = map(int, every)
            assert 1 <= len(range(start, n, step)) <= 20


def test_sensitivity_has_a_line_for_each_seed_and_the_diagonal() -> None:
    rows = [*obtained(2, [200, 0, 100]), *obtained(1)]
    figure = sensitivity_figure(rows, "LunarLander")
    lines = labelled(figure)
    assert list(lines) == ["obtained = desired", "seed 1", "seed 2"]
    (axes,) = figure.axes
    assert axes.get_title() == "LunarLander"
    assert axes.get_xlabel() == "desired return"
    assert axes.get_ylabel() == "obtained return"
    assert data(lines["seed 2"]) == ([0, 100, 200], [2, 52, 102])
    diagonal = lines["obtained = desired"]
    assert data(diagonal) == ([0, 200], [0, 200])
    assert diagonal.get_linestyle() == ":"


def test_error_bars_are_the_standard_deviation() -> None:
    (axes,) = sensitivity_figure(obtained(1), "").axes
    (bars,) = axes.collections
    assert isinstance(bars, LineCollection)
    assert [np.asarray(segment)[:, 1].tolist() for segment in bars.get_segments()] == [
        pytest.approx([mean - 50, mean + 50]) for mean in (1, 51, 101)
    ]


DRAWINGS: list[Callable[[], Figure]] = [
    lambda: learning_curves(ALL, "LunarLander", references={"solved": 200}),
    lambda: sensitivity_figure([*obtained(1), *obtained(2)], "LunarLander"),
]


@pytest.mark.parametrize("draw", DRAWINGS)
def test_equal_rows_give_equal_bytes(draw: Callable[[], Figure], tmp_path: Path) -> None:
    figure = draw()
    pictures = [
        [path.read_bytes() for path in save(figure, tmp_path / name)]
        for figure, name in ((figure, "one"), (figure, "again"), (draw(), "other"))
    ]
    assert pictures[0] == pictures[1] == pictures[2]


def test_only_two_files_are_written(tmp_path: Path) -> None:
    written = save(learning_curves(curve(), ""), tmp_path / "LunarLander-v3.5")
    assert [path.name for path in written] == ["LunarLander-v3.5.png", "LunarLander-v3.5.svg"]
    assert sorted(tmp_path.iterdir()) == written
    png, svg = (path.read_bytes() for path in written)
    assert png.startswith(b"\x89PNG")
    assert b"Software" not in png
    assert b"<dc:date>" not in svg


def test_text_is_stored_as_text(tmp_path: Path) -> None:
    points = [*curve("UDRL", "lead 2"), *curve("A2C")]
    figure = learning_curves(points, "The lander", references={"solved": 200})
    svg = save(figure, tmp_path / "curves")[1].read_text(encoding="utf-8")
    for words in ("UDRL lead 2 (20 seeds)", "A2C (20 seeds)", "The lander", "solved",
                  "env steps (millions)", "mean return"):  # fmt: skip
        assert f">{words}</text>" in svg


@pytest.mark.parametrize("points", [ALL, MANY, curve("UDRL", "with a name that is long" * 3)])
def test_nothing_is_clipped_or_covered(points: Sequence[CurvePoint], tmp_path: Path) -> None:
    figure = learning_curves(points, "LunarLander", references={"close to optimal": 200})
    save(figure, tmp_path / "curves")
    width, height = figure.get_size_inches()
    outline = figure.get_tightbbox()
    assert 0 <= outline.x0 < outline.x1 <= width
    assert 0 <= outline.y0 < outline.y1 <= height
    (axes,), (legend,) = figure.axes, figure.legends
    assert legend.get_window_extent().y1 <= axes.xaxis.label.get_window_extent().y0
    assert axes.get_position().height * height > 3


def test_empty_table_is_an_error() -> None:
    with pytest.raises(ConfigError, match="lander: the table of the figure is empty; expected"):
        learning_curves([], "lander")
    with pytest.raises(ConfigError, match="lander: the table of the figure is empty; expected"):
        sensitivity_figure([], "lander")


@pytest.mark.parametrize("draw", DRAWINGS)
def test_missing_matplotlib_is_reported_with_the_remedy(
    draw: Callable[[], Figure], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ConfigError, match=r'pip install "udrl\[studies\]"'):
        draw()
