"""Shell completion of environments, presets, weights versions and settings."""

from contextlib import closing, suppress
from pathlib import Path

import click

from udrl.config import Budget, Config, preset_names, setting_names
from udrl_launch.settings import NO_PRESET, Fleet


def environments(context: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """Return the registered Gymnasium ids, with the latest version of each environment."""
    import gymnasium as gym

    import udrl.environments  # noqa: F401 - registers environments

    latest: dict[str, tuple[int, str]] = {}
    for name, spec in gym.registry.items():
        base, version = name.removesuffix(f"-v{spec.version}"), spec.version or 0
        latest[base] = max(latest.get(base, (0, "")), (version, name))
    found = [name for _, name in latest.values()]
    return sorted(name for name in found if name.startswith(incomplete))


def presets(context: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """Return the names of presets."""
    return [n for n in (*preset_names(), NO_PRESET) if n.startswith(incomplete)]


def weights(context: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """Return the weights versions that the run keeps."""
    from udrl.errors import UdrlError
    from udrl_replay.store import Store

    names = ["latest", "best"]
    # While the option has no value, click leaves the arguments unparsed.
    run_dir = context.params.get("run_dir") or next(iter(context.args), None)
    if run_dir is not None:
        # The command itself reports an error.
        with suppress(UdrlError), closing(Store(Path(run_dir), read_only=True)) as store:
            names += [str(version) for version in store.versions_kept()]
    return [name for name in names if name.startswith(incomplete)]


def settings(context: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """Return the names of settings, each with an equals sign."""
    names = (name for kind in (Config, Budget, Fleet) for name in setting_names(kind))
    return [f"{n}=" for n in names if n != "environment" and n.startswith(incomplete)]
