"""The board's web server: the page, its updates, and a stage for each viewer."""

import asyncio
import contextlib
import hashlib
import hmac
import logging
import re
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from concurrent.futures import CancelledError
from importlib import resources
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import anyio
import msgspec
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.requests import HTTPConnection, Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from udrl_board.feed import Feed
from udrl_board.stage import Stage
from udrl_board.stage_messages import Moment, StageProblem, StageRequest
from udrl_proto.text import as_json

log = logging.getLogger("udrl")

#: Maximum number of stages at once; each has its own environment.
MOST_STAGES = 8
#: Maximum size of a request to a stage, in bytes; the web server checks it.
MOST_BYTES = 4096
#: Seconds without a request after which an idle stage is closed.
IDLE_S = 300.0
#: Timeout for sending a picture, seconds; a slower viewer is disconnected.
_SEND_S = 20.0


_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


def make_app(
    *feeds: Feed,
    hosts: tuple[str, ...] = (),
    token: str = "",
    origins: tuple[str, ...] = (),
) -> Starlette:
    """Return the web application.

    Args:
        feeds: the feeds of the runs to show.
        hosts: host names that requests may use; empty: any. Prevents DNS rebinding.
        token: token that browsers need; empty: none.
        origins: origins of the board behind a proxy, e.g. ``https://hub.example``.
    """
    static = Path(str(resources.files("udrl_board"))) / "static"
    board = _Board(feeds)

    @contextlib.asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        yield
        for feed in feeds:
            feed.source.close()

    return Starlette(
        routes=[
            Route("/news", board.news),
            Route("/runs", board.runs),
            WebSocketRoute("/stage", board.stage),
            Mount("/", StaticFiles(directory=static, html=True)),
        ],
        middleware=[Middleware(_Guard, hosts=hosts, token=token, origins=origins)],
        lifespan=lifespan,
    )


class _Guard:
    """Admits requests with the token, to one of the board's host names, from its own page."""

    def __init__(
        self, app: ASGIApp, *, hosts: tuple[str, ...], token: str, origins: tuple[str, ...]
    ) -> None:
        self._app = app
        self._hosts = hosts
        self._token = token
        self._origins = origins
        # A unique name, because browsers share cookies between all ports of a host.
        self._cookie = f"udrl_board_{hashlib.sha256(token.encode()).hexdigest()[:16]}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        connection = HTTPConnection(scope)
        refusal = self._refusal(connection)
        if scope["type"] == "websocket":
            if refusal is not None:
                await send({"type": "websocket.close", "code": 1008})
                return
            await self._app(scope, receive, send)
            return
        response = refusal or self._login(connection)
        if response is not None:
            response.headers.update(_HEADERS)
            await response(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = [(k.lower().encode(), v.encode()) for k, v in _HEADERS.items()]
                message["headers"] = [*message["headers"], *headers]
            await send(message)

        await self._app(scope, receive, with_headers)

    def _refusal(self, connection: HTTPConnection) -> Response | None:
        """Return the response to a request that is not admitted; None: it is."""
        host = connection.headers.get("host", "")
        origin = connection.headers.get("origin")
        try:
            name = urlsplit(f"//{host}").hostname or ""
            page = urlsplit(origin).netloc if origin is not None else host
        except ValueError:
            return PlainTextResponse("Invalid Host or Origin header.", 400)
        if self._hosts and name not in self._hosts:
            return PlainTextResponse(
                f"This board is not served as {name!r}; open the address that `udrl board` "
                f"printed.",
                421,
            )
        if page != host and origin not in self._origins:
            return PlainTextResponse(
                f"Requests from {origin} are not allowed; if the board is behind a proxy with this "
                f"origin, start `udrl board` with --allow-origin {origin}.",
                403,
            )
        if self._token and not self._has_token(connection):
            return PlainTextResponse(
                "This board needs a token: open the address that `udrl board` printed.",
                401,
            )
        return None

    def _has_token(self, connection: HTTPConnection) -> bool:
        # Starlette parses cookies as browsers do: another program's odd cookie hides no other.
        tokens = [connection.cookies.get(self._cookie, ""), *self._tokens_in_address(connection)]
        return any(hmac.compare_digest(one.encode(), self._token.encode()) for one in tokens)

    def _tokens_in_address(self, connection: HTTPConnection) -> list[str]:
        return parse_qs(connection.url.query).get("token", [])

    def _login(self, connection: HTTPConnection) -> Response | None:
        """Move a token from the address to a cookie; None: the address has no token."""
        if not self._token or not self._tokens_in_address(connection):
            return None
        # A proxy may serve the board under a path that only the browser knows, so the redirect is
        # relative, and the cookie gets the default path.
        response = RedirectResponse("./", 303)
        response.set_cookie(self._cookie, self._token, path=None, httponly=True, samesite="strict")
        return response


class _Board:
    """The handlers of the routes."""

    def __init__(self, feeds: Sequence[Feed]) -> None:
        self._feeds = feeds
        self._stages: list[Stage] = []

    def _feed(self, connection: HTTPConnection) -> Feed:
        """Return the feed of the run that a page shows; the first if there is no such run."""
        number = connection.query_params.get("number", "")
        known = {str(k): feed for k, feed in enumerate(self._feeds)}
        return known.get(number, self._feeds[0])

    async def runs(self, request: Request) -> Response:
        """Return all runs of the board."""
        rows = [await run_in_threadpool(feed.summary) for feed in self._feeds]
        return Response(as_json(rows), media_type="application/json")

    async def news(self, request: Request) -> Response:
        """Return the changes since an iteration."""
        text = request.query_params.get("after", "-1")
        if not re.fullmatch(r"-?\d{1,18}", text):
            return PlainTextResponse(f"after={text[:40]!r}: expected an iteration", 400)
        run_id = request.query_params.get("run", "")
        news = await run_in_threadpool(self._feed(request).news, int(text), run_id)
        return Response(as_json(news), media_type="application/json")

    async def stage(self, socket: WebSocket) -> None:
        """Receive a viewer's requests and show the episodes."""
        await socket.accept()
        # A stage counts until its thread has ended: it may still be creating an environment.
        self._stages = [stage for stage in self._stages if stage.is_alive()]
        if len(self._stages) >= MOST_STAGES:
            problem = f"all {MOST_STAGES} stages are in use; try again later"
            await socket.send_text(as_json(StageProblem(problem=problem)).decode())
            await socket.close(1013)
            return
        stage = Stage(self._feed(socket).source, _sender(socket, asyncio.get_running_loop()))
        stage.start()
        self._stages.append(stage)
        try:
            await _listen(socket, stage)
        finally:
            stage.close()
            await run_in_threadpool(stage.join)


async def _listen(socket: WebSocket, stage: Stage) -> None:
    """Forward requests until the viewer disconnects."""
    while True:
        try:
            text = await asyncio.wait_for(socket.receive_text(), IDLE_S)
        except TimeoutError:
            if stage.is_acting:
                continue
            await socket.close(1001, f"Closed after {IDLE_S:.0f} seconds without a request")
            return
        except (WebSocketDisconnect, KeyError):  # a binary message has no text
            return
        problem = ""
        try:
            if not stage.request(msgspec.json.decode(text, type=StageRequest)):
                problem = "too many requests at once"
        except (msgspec.ValidationError, msgspec.DecodeError, RecursionError) as error:
            problem = f"invalid request: {error}"
        if problem:
            await socket.send_text(as_json(StageProblem(problem=problem)).decode())


#: Exceptions of sending when the socket or the event loop is closed.
_GONE = (
    RuntimeError, WebSocketDisconnect, TimeoutError, CancelledError,
    anyio.BrokenResourceError, anyio.ClosedResourceError,
)  # fmt: skip

Sender = Callable[[Moment | StageProblem, bytes | None], None]


def _sender(socket: WebSocket, loop: asyncio.AbstractEventLoop) -> Sender:
    """Return a function that sends a stage's moments, and waits until they are sent."""

    async def send(news: Moment | StageProblem, picture: bytes | None) -> None:
        await socket.send_text(as_json(news).decode())
        if picture is not None:
            await socket.send_bytes(picture)

    def show(news: Moment | StageProblem, picture: bytes | None) -> None:
        sending: Awaitable[None] = asyncio.wait_for(send(news, picture), _SEND_S)
        try:
            asyncio.run_coroutine_threadsafe(sending, loop).result(_SEND_S + 1)  # type: ignore[arg-type]
        except _GONE as error:
            raise ConnectionError(f"the viewer has disconnected: {error}") from error

    return show
