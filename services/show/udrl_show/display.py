"""Live progress on standard error: a panel in a terminal, plain lines everywhere else."""

import math
import time
from collections.abc import Iterable, Sequence
from types import TracebackType
from typing import Self

from rich.console import Console, ConsoleOptions, RenderResult
from rich.live import Live
from rich.measure import Measurement
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from udrl.evaluation import interval_text, return_text
from udrl_proto.reports import AuditStatus, EvaluationStatus, Status, Waiting
from udrl_proto.text import printable

#: Seconds between lines if there is no terminal.
_PLAIN_EVERY_S = 5.0
#: Width of the progress bar, in characters; less in a narrow terminal.
_BAR_WIDTH = 20
#: Maximum number of weights versions to list; of more, the first and the last ones are listed.
_MAX_LISTED = 8
#: Texts for the states.
_STATE_LABELS = {
    "running": "running",
    "finishing": "final evaluation",
    "ended": "ended",
    "failed": "failed",
    "stopped": "stopped",
}
#: States in which processes of the run are connected.
_LIVE = "running", "finishing"


class Display:
    """Shows the status of a run while it trains."""

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or Console(stderr=True)
        self._live = (
            Live(console=self._console, auto_refresh=False, transient=True)
            if _can_be_redrawn(self._console)
            else None
        )
        self._printed_at = -_PLAIN_EVERY_S
        self._evaluated = -1

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, status: Status) -> None:
        """Show a status."""
        if self._live is not None:
            self._live.update(panel(status), refresh=True)
            return
        evaluated = status.evaluation.iteration if status.evaluation else -1
        now = time.monotonic()
        if evaluated != self._evaluated or now - self._printed_at >= _PLAIN_EVERY_S:
            self._printed_at, self._evaluated = now, evaluated
            self._console.print(line(status), soft_wrap=True, highlight=False, markup=False)


def _can_be_redrawn(console: Console) -> bool:
    """Return whether a panel can be redrawn; forced colours do not make a log a terminal."""
    return console.is_terminal and not console.is_dumb_terminal and console.file.isatty()


def line(status: Status) -> str:
    """Return a status in one line."""
    parts = [
        f"{_STATE_LABELS[status.state]}: iteration {status.iteration}",
        f"{status.env_steps:,} of {status.max_env_steps:,} env steps "
        f"({status.env_steps_per_s:,.0f}/s)",
        f"evaluation {evaluation(status.evaluation)}",
        f"replay buffer {', '.join(returns(status))}",
        f"weights version {status.weights_version} (lag {status.weights_lag})",
    ]
    if status.time_left_s is not None:
        parts.append(time_left(status))
    if status.ended_because:
        parts.append(status.ended_because)
    parts += map(_waiting, _long_waits(status))
    return printable("; ".join(parts))


def panel(status: Status) -> Table:
    """Return a status as a table."""
    table = Table(show_header=False, box=None, padding=(0, 1), pad_edge=False)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")

    def add(name: str, *phrases: str) -> None:
        table.add_row(name, Phrases(phrases))

    add("run", status.run_id)
    add("environment", status.environment)
    add("state", f"{_STATE_LABELS[status.state]}{'' if status.exact else ', NOT exact'}")
    table.add_row("progress", _progress(status))
    if status.stop_return is not None:
        add("target", f"mean return {return_text(status.stop_return)} in an evaluation")
    add("env steps", *_separated(_env_steps(status)))
    add("iteration", f"{status.iteration:,}")
    add("evaluation", *_evaluation(status.evaluation, has_ended=status.state not in _LIVE))
    if status.final_evaluation:
        add("final evaluation", *_evaluation(status.final_evaluation))
    add("replay buffer", *_separated(returns(status)))
    add("weights", *_separated(_weights(status)))
    if status.weights_kept:
        add("weights kept", *_kept(status.weights_kept))
    if status.state in _LIVE:
        add("actors", *_actors(status))
    left = [time_left(status)] if status.time_left_s is not None else []
    add("time", *_separated([f"{duration(status.wall_s)} elapsed", *left]))
    if status.audit.rate:
        add("audit", *_separated(_audit(status.audit)))
    if status.ended_because:
        add("reason", status.ended_because)
    if status.advice:
        add("advice", status.advice)
    for actor in status.quarantined:
        add("quarantined", f"{actor.id}: {actor.why}")
    for wait in _long_waits(status):
        add("waiting", f"{wait.who} for {wait.on}:", f"{wait.why} ({wait.seconds:.1f} s)")
    return table


class Phrases:
    """Text that is wrapped between phrases; a phrase wider than a line is wrapped too.

    Args:
        phrases: separated by spaces when they share a line.
    """

    def __init__(self, phrases: Iterable[str]) -> None:
        self._phrases = [printable(phrase) for phrase in phrases]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        lines = wrapped(self._phrases, options.max_width)
        yield Text("\n".join(lines), overflow="fold")

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        words = [word for phrase in self._phrases for word in phrase.split()]
        shortest = max(map(len, words), default=0)
        longest = len(" ".join(self._phrases))
        return Measurement(shortest, longest).with_maximum(options.max_width)


def wrapped(phrases: Iterable[str], width: int) -> list[str]:
    """Return phrases as lines of at most ``width`` characters; a longer phrase is a line itself."""
    lines: list[str] = []
    for phrase in phrases:
        if lines and len(lines[-1]) + 1 + len(phrase) <= width:
            lines[-1] += f" {phrase}"
        else:
            lines.append(phrase)
    return lines


def _separated(phrases: Sequence[str]) -> list[str]:
    """Return phrases with a semicolon after each but the last."""
    return [f"{phrase};" for phrase in phrases[:-1]] + list(phrases[-1:])


def _env_steps(status: Status) -> list[str]:
    evaluating = status.eval_env_steps
    more = [f"{evaluating:,} more in evaluations"] if evaluating else []
    rate = [f"{status.env_steps_per_s:,.0f} per second"] if status.state in _LIVE else []
    return [f"{status.env_steps:,}", *rate, *more]


def _weights(status: Status) -> list[str]:
    loss = [f"loss {status.loss:.3f}"] if status.loss is not None else []
    lag = f"lag {_counted(status.weights_lag, 'version')} and {status.weights_lag_s:.2f} s"
    lags = [lag] if status.state in _LIVE else []
    return [f"version {status.weights_version:,}", *loss, *lags]


def _actors(status: Status) -> list[str]:
    environments = sum(actor.environments for actor in status.actors)
    running = sum(actor.running for actor in status.actors)
    return [
        f"{len(status.actors)} with",
        f"{_counted(environments, 'environment')};",
        f"{_counted(running, 'episode')} running;",
        f"at most {status.useful_concurrency:,} at once",
    ]


def _audit(audit: AuditStatus) -> list[str]:
    counts = [f"{audit.agreed} agreed", f"{audit.open} open", f"{audit.disputed} disputed"]
    return [f"{100 * audit.rate:g} % of the episodes", *counts]


def _kept(versions: Sequence[int]) -> list[str]:
    """Return the number of versions, and the first and the last of them."""
    names = [f"{version}" for version in versions]
    if len(names) > _MAX_LISTED:
        half = _MAX_LISTED // 2
        names = [*names[:half], "…", *names[-half:]]
    listed = [f"{name}," for name in names[:-1]] + names[-1:]
    return [f"{_counted(len(versions), 'version')}:", *(n.replace("…,", "…") for n in listed)]


def _progress(status: Status) -> Table:
    """Return a bar and a percentage of the budget of env steps."""
    row = Table.grid(padding=(0, 1))
    row.add_column()
    row.add_column(no_wrap=True)
    done = min(1.0, status.env_steps / status.max_env_steps) if status.max_env_steps else 0.0
    bar = ProgressBar(total=1.0, completed=done, width=_BAR_WIDTH)
    row.add_row(bar, f"{math.floor(100 * done)} % of {status.max_env_steps:,} env steps")
    return row


def _counted(number: int, noun: str) -> str:
    """Return a number with its noun."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def _waiting(wait: Waiting) -> str:
    return f"{wait.who} waits for {wait.on}: {wait.why} ({wait.seconds:.1f} s)"


def _long_waits(status: Status) -> list[Waiting]:
    return [w for w in status.waiting if w.seconds >= 1.0]


def evaluation(result: EvaluationStatus | None) -> str:
    """Return an evaluation as mean and the half width of its 95 % interval."""
    return " ".join(_evaluation(result))


def _evaluation(result: EvaluationStatus | None, *, has_ended: bool = False) -> list[str]:
    if result is None:
        return ["none" if has_ended else "none yet"]
    half = (result.ci95_high - result.ci95_low) / 2
    return [
        f"mean return {interval_text(result.mean, half)}",
        f"at {result.env_steps:,} env steps",
    ]


def returns(status: Status) -> list[str]:
    """Return the lowest, mean and highest return in the buffer as phrases."""
    held = status.buffer
    if held.return_min is None or held.return_mean is None or held.return_max is None:
        return ["empty"]
    values = (held.return_min, held.return_mean, held.return_max)
    names = "lowest return", "mean", "highest"
    return [f"{name} {return_text(v)}" for name, v in zip(names, values, strict=True)]


def time_left(status: Status) -> str:
    """Return the time left; "at most" if an evaluation may reach ``stop_return`` earlier."""
    most = "" if status.stop_return is None else "at most "
    return f"{most}{duration(status.time_left_s or 0.0)} left"


def duration(seconds: float) -> str:
    """Return a duration as h:mm:ss or m:ss."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
