"""``udrl board``."""

import ipaddress
import logging
import re
import secrets
import socket
import threading
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING

import click

from udrl.errors import ConfigError
from udrl_launch.process import GRACE_S, log_to_stderr, run_service
from udrl_launch.subcommands.options import CONNECT, KEYS, RUN, RUN_DIR, place

if TYPE_CHECKING:
    import uvicorn

#: Names of the loopback interface.
_LOOPBACK = ("127.0.0.1", "localhost", "::1")
#: Wildcard addresses; the host name is shown instead.
_EVERYWHERE = ("0.0.0.0", "::")  # noqa: S104 - not bound here


@click.command()
@click.argument("run_dirs", metavar="RUN_DIR...", type=RUN_DIR, nargs=-1)
@CONNECT
@click.option("--port", type=click.IntRange(0, 65_535), default=0, show_default=True,
              metavar="PORT", help="Port to serve on; 0 = any free port.")  # fmt: skip
@click.option("--host", default="127.0.0.1", show_default=True, metavar="ADDRESS",
              help="Address to serve on. Beyond loopback, browsers need a token.")  # fmt: skip
@click.option(
    "--token",
    envvar="UDRL_BOARD_TOKEN",
    metavar="TOKEN",
    help="Token that browsers need. Default: a new one beyond loopback or behind a proxy.",
)
@click.option("--allow-origin", "origins", multiple=True, metavar="ORIGIN",
              help="Origin of the board behind a proxy, e.g. https://hub.example. May be "
              "repeated.")  # fmt: skip
@click.option("--open", "opens", is_flag=True, help="Open the board in the browser.")
@KEYS
@RUN
def board(
    run_dirs: tuple[Path, ...],
    connect: str | None,
    port: int,
    host: str,
    token: str | None,
    origins: tuple[str, ...],
    opens: bool,
    keys: Path | None,
    run_id: str | None,
) -> int:
    """Watch runs and command their agents in the browser.

    Pass either RUN_DIR or --connect ENDPOINT. With several directories, the page compares the runs.

    Example: udrl board runs/mine --open
    """
    where = place(run_dirs[0] if run_dirs else None, connect, run_id, keys)
    try:
        import uvicorn

        from udrl_board.app import MOST_BYTES, make_app
        from udrl_board.feed import Feed
        from udrl_board.source import Directory, Served, Source
    except ModuleNotFoundError as error:
        raise ConfigError(
            f'the board needs {error.name}; install it with: pip install "udrl[board]"'
        ) from error
    sources: list[Source] = [Directory(run_dir, keys) for run_dir in run_dirs]
    if not isinstance(where, Path):
        sources = [Served(where)]
    for source in sources:
        source.hello()  # raises if there is no run
    is_local = _is_loopback(host)
    proxies = tuple(map(_host_of, origins))
    if origins or not is_local:
        token = token or secrets.token_urlsafe(18)
    if token is not None:
        _check_token(token)
    log_to_stderr(logging.WARNING)
    app = make_app(
        *map(Feed, sources), hosts=(*_LOOPBACK, host, *proxies) if is_local else (),
        token=token or "", origins=origins,
    )  # fmt: skip
    with _listening(host, port) as listener:
        address = _address(host, listener.getsockname()[1], token)
        server = uvicorn.Server(
            uvicorn.Config(
                app,
                log_level="warning",
                access_log=False,
                timeout_graceful_shutdown=2,
                ws_max_size=MOST_BYTES,
                server_header=False,
            )
        )

        def service(stop: threading.Event) -> None:
            click.echo(f"board: {address}")
            if opens:
                webbrowser.open(address)
            _serve(server, listener, stop)

        return run_service(service)


def _serve(server: "uvicorn.Server", listener: socket.socket, stop: threading.Event) -> None:
    """Serve until ``stop`` is set."""
    thread = threading.Thread(target=server.run, args=([listener],), daemon=True)
    thread.start()
    while thread.is_alive() and not stop.wait(0.2):
        pass
    server.should_exit = True
    thread.join(GRACE_S)


def _check_token(token: str) -> None:
    if not re.fullmatch(r"[A-Za-z0-9._~-]{1,200}", token):
        raise ConfigError(
            "--token: expected 1 to 200 letters, digits and . _ ~ -, because it is part of an "
            "address"
        )


def _address(host: str, port: int, token: str | None) -> str:
    """Return the address for the browser."""
    shown = socket.gethostname() if host in _EVERYWHERE else host
    shown = f"[{shown}]" if ":" in shown else shown
    return f"http://{shown}:{port}/{f'?token={token}' if token else ''}"


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _host_of(origin: str) -> str:
    """Return the host name of an origin.

    Raises:
        ConfigError: it is not an origin in the form that browsers send.
    """
    found = re.fullmatch(r"https?://([a-z0-9.-]+|\[[0-9a-f:]+\])(:[0-9]{1,5})?", origin)
    if found is None:
        raise ConfigError(
            f"--allow-origin {origin}: expected scheme, host and optional port as browsers send "
            f"them, in lower case and without a path, e.g. https://hub.example"
        )
    return found[1].strip("[]")


def _listening(host: str, port: int) -> socket.socket:
    listener = None
    try:
        family, kind, _, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        listener = socket.socket(family, kind)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen()
    except (OSError, UnicodeError) as error:
        if listener is not None:
            listener.close()
        raise ConfigError(
            f"--host {host} --port {port}: {error}; choose an address of this machine and a free "
            f"port, or port 0"
        ) from error
    return listener
