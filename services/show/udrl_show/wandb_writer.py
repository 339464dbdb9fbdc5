"""Weights & Biases."""

import os
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from udrl.errors import ConfigError
from udrl_show.run_log import FINISH_S, Logged
from udrl_show.scalars import Scalar

#: The summary's entry that says why a run ended.
_ENDED = "ended_because"
_STEPS = "env_steps"


class WandbWriter:
    """A run in Weights & Biases, with the same id; its x-axis is ``env_steps``.

    ``WANDB_PROJECT`` names the project, by default ``udrl``. With ``WANDB_MODE=offline`` each start
    writes the whole run to a new folder for ``wandb sync``.

    Args:
        run_dir: the run's directory, in which W&B has its own.

    Raises:
        ConfigError: the extra is not installed.
    """

    def __init__(self, run_dir: Path) -> None:
        try:
            import wandb
        except ModuleNotFoundError as error:
            raise ConfigError(
                'Weights & Biases needs wandb; install it with: pip install "udrl[wandb]"'
            ) from error
        if wandb.run is None:  # else the caller has a run, which this would silence
            wandb.setup(wandb.Settings(silent=True))  # also, it does not ask for a login
        self.place = ""
        self._run_dir = run_dir
        self._is_ended = False
        self._run: Any = None

    def begin(self, run_id: str, settings: dict[str, Any], began: float) -> Logged:
        """Begin or continue the run."""
        import wandb

        self._run = wandb.init(
            project=os.environ.get("WANDB_PROJECT", "udrl"),
            id=run_id,
            name=self._run_dir.name,
            dir=self._run_dir,
            config=settings,
            allow_val_change=True,  # the budget of an extended run
            resume="allow",
            reinit="create_new",  # the caller may have a run of its own
            settings=wandb.Settings(
                console="off", silent=True, init_timeout=FINISH_S / 2, finish_timeout=FINISH_S / 2
            ),
        )
        self._run.define_metric(_STEPS)
        self._run.define_metric("*", step_metric=_STEPS)
        self.place = str(Path(self._run.dir).parent) if self._run.offline else self._run.url
        summary = self._run.summary
        self._is_ended = bool(summary.get(_ENDED))
        return Logged(int(summary.get("time/iterations", -1)), self._is_ended)

    def write(self, scalars: Sequence[Scalar]) -> None:
        """Write scalars, those of the same env steps together."""
        if self._is_ended:
            self._is_ended = False
            self._run.summary[_ENDED] = ""
        for env_steps, group in groupby(scalars, lambda scalar: scalar.env_steps):
            self._run.log({_STEPS: env_steps} | {scalar.tag: scalar.value for scalar in group})

    def end(self, because: str) -> None:
        """Say in the summary why the run ended."""
        self._is_ended = True
        self._run.summary[_ENDED] = because

    def close(self) -> None:
        """Upload the rest."""
        if self._run is not None:
            self._run.finish()
