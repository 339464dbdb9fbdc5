"""Live progress: a panel in a terminal, plain lines everywhere else. It goes to standard error."""

import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from udrl.evaluation import return_text
from udrl_proto.reports import EvaluationStatus, Status, Waiting
from udrl_proto.text import printable

_PLAIN_EVERY_S = 5.0


class Display:
    """Shows the status of a run while it goes on."""

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
    """Say whether a panel can be drawn over; colours that are forced make no terminal of a log."""
    return console.is_terminal and not console.is_dumb_terminal and console.file.isatty()


def line(status: Status) -> str:
    """Return a status in one line."""
    parts = [
        f"{status.state}: iteration {status.iteration}",
        f"{status.env_steps:,} env steps ({status.env_steps_per_s:,.0f}/s)",
        f"evaluation {evaluation(status.evaluation)}",
        f"buffer {returns(status)}",
        f"weights {status.weights_version} (lag {status.weights_lag})",
    ]
    if status.time_left_s is not None:
        parts.append(f"left {time_left(status)}")
    if status.ended_because:
        parts.append(status.ended_because)
    parts += [f"{w.who} waits for {w.on}: {w.why} ({w.seconds:.1f} s)" for w in _long(status)]
    return printable("; ".join(parts))


def panel(status: Status) -> Table:
    """Return a status as a table."""
    table = Table(show_header=False, box=None, padding=(0, 1), pad_edge=False)
    table.add_column(style="dim", no_wrap=True)
    table.add_column()
    rows = {
        "run": f"{status.run_id} ({status.state}{'' if status.exact else ', NOT exact'})",
        "iteration": f"{status.iteration}",
        "env steps": f"{status.env_steps:,} of {status.max_env_steps:,} "
        f"({status.env_steps_per_s:,.0f}/s; evaluation steps {status.eval_env_steps:,})",
        "evaluation": evaluation(status.evaluation),
        **({"closing": evaluation(status.closing_evaluation)} if status.closing_evaluation else {}),
        "buffer": returns(status),
        "weights": f"version {status.weights_version}, lag {status.weights_lag} versions, "
        f"{status.weights_lag_s:.2f} s"
        + (f", loss {status.loss:.3f}" if status.loss is not None else ""),
        "actors": f"{len(status.actors)} with {sum(a.environments for a in status.actors)} "
        f"environments, {sum(a.running for a in status.actors)} of at most "
        f"{status.useful_concurrency} episodes under way",
        "time": f"{duration(status.wall_s)}"
        + (f", left {time_left(status)}" if status.time_left_s is not None else ""),
    }
    if status.audit.rate:
        audit = status.audit
        rows["audit"] = (
            f"{100 * audit.rate:g} % of the episodes; {audit.agreed} agreed, {audit.open} open, "
            f"{audit.disputed} disputed"
        )
    if status.ended_because:
        rows["because"] = status.ended_because
    if status.advice:
        rows["advice"] = status.advice
    for name, value in rows.items():
        table.add_row(name, Text(printable(value)))
    for actor in status.quarantined:
        table.add_row("quarantined", Text(printable(f"{actor.id}: {actor.why}")))
    for wait in _long(status):
        said = f"{wait.who} for {wait.on}: {wait.why} ({wait.seconds:.1f} s)"
        table.add_row("waiting", Text(printable(said)))
    return table


def _long(status: Status) -> list[Waiting]:
    return [w for w in status.waiting if w.seconds >= 1.0]


def evaluation(result: EvaluationStatus | None) -> str:
    """Return an evaluation as mean and the half width of its 95 % interval."""
    if result is None:
        return "none yet"
    half = (result.ci95_high - result.ci95_low) / 2
    return f"{return_text(result.mean)} ± {return_text(half)} at {result.env_steps:,}"


def returns(status: Status) -> str:
    """Return the returns in the buffer: min / mean / max."""
    held = status.buffer
    if held.return_min is None or held.return_mean is None or held.return_max is None:
        return "empty"
    return " / ".join(map(return_text, (held.return_min, held.return_mean, held.return_max)))


def time_left(status: Status) -> str:
    """Return how long a run goes on; nobody knows when an evaluation will reach its stop_return."""
    most = "" if status.stop_return is None else "at most "
    return most + duration(status.time_left_s or 0.0)


def duration(seconds: float) -> str:
    """Return a duration as h:mm:ss or m:ss."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
