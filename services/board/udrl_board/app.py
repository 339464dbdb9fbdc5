"""The board's web server: the page, its news, and a stage for every viewer."""

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

log = logging.getLogger("udrl")

#: Stages at a time; each has an environment of its own.
MOST_STAGES = 8
#: Bytes of a request; the web server checks.
MOST_BYTES = 4096
#: Seconds without a request after which an idle stage is closed.
IDLE_S = 300.0
#: Seconds that a picture may take to be sent; a slower viewer is disconnected.
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
        feeds: of the runs that it shows.
        hosts: names that it may be called by; empty: any. A page of elsewhere whose name leads here
            (DNS rebinding) is refused by it.
        token: what a browser must know; empty: nothing.
        origins: of pages that are the board's own as a proxy shows them, e.g.
            ``https://hub.example``.
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
    """Admits requests that have the token and one of the board's names, from its own page."""

    def __init__(
        self, app: ASGIApp, *, hosts: tuple[str, ...], token: str, origins: tuple[str, ...]
    ) -> None:
        self._app = app
        self._hosts = hosts
        self._token = token
        self._origins = origins
        # Of its own: browsers keep one jar for all ports of a host.
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
        response = refusal or self._welcome(connection)
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
        host = connection.headers.get("host", "")
        origin = connection.headers.get("origin")
        try:
            name = urlsplit(f"//{host}").hostname or ""
            page = urlsplit(origin).netloc if origin is not None else host
        except ValueError:
            return PlainTextResponse("Neither Host nor Origin can be read.", 400)
        if self._hosts and name not in self._hosts:
            return PlainTextResponse(f"This board is not called {name!r}.", 421)
        if page != host and origin not in self._origins:
            return PlainTextResponse(
                f"A page of {origin} may not use this board; if it is the board's own, behind a "
                f"proxy, start `udrl board` with --allow-origin {origin}.",
                403,
            )
        if self._token and not self._knows(connection):
            return PlainTextResponse(
                "This board asks for a token: open it by the address that `udrl board` printed.",
                401,
            )
        return None

    def _knows(self, connection: HTTPConnection) -> bool:
        # Starlette's reading is the browsers': a strange cookie of another program hides no other.
        shown = [connection.cookies.get(self._cookie, ""), *self._shown(connection)]
        return any(hmac.compare_digest(one.encode(), self._token.encode()) for one in shown)

    def _shown(self, connection: HTTPConnection) -> list[str]:
        return parse_qs(connection.url.query).get("token", [])

    def _welcome(self, connection: HTTPConnection) -> Response | None:
        """Turn a token in the address into a cookie, so that it does not stay there."""
        if not self._token or not self._shown(connection):
            return None
        # A proxy may show the board under a path that only the browser knows: so the redirect is
        # relative, and the cookie has the path that it was set at.
        response = RedirectResponse("./", 303)
        response.set_cookie(self._cookie, self._token, path=None, httponly=True, samesite="strict")
        return response


class _Board:
    """What the routes do."""

    def __init__(self, feeds: Sequence[Feed]) -> None:
        self._feeds = feeds
        self._stages = 0

    def _feed(self, connection: HTTPConnection) -> Feed:
        """Return the feed of the run that a page shows; the first, if there is no such run."""
        number = connection.query_params.get("number", "")
        known = {str(k): feed for k, feed in enumerate(self._feeds)}
        return known.get(number, self._feeds[0])

    async def runs(self, request: Request) -> Response:
        """Answer with all runs of the board."""
        rows = [await run_in_threadpool(feed.summary) for feed in self._feeds]
        return Response(msgspec.json.encode(rows), media_type="application/json")

    async def news(self, request: Request) -> Response:
        """Answer what is new after an iteration."""
        text = request.query_params.get("after", "-1")
        if not re.fullmatch(r"-?\d{1,18}", text):
            return PlainTextResponse(f"after={text[:40]!r}: expected an iteration", 400)
        run_id = request.query_params.get("run", "")
        news = await run_in_threadpool(self._feed(request).news, int(text), run_id)
        return Response(msgspec.json.encode(news), media_type="application/json")

    async def stage(self, socket: WebSocket) -> None:
        """Take a viewer's requests, and show the episodes."""
        await socket.accept()
        if self._stages >= MOST_STAGES:
            problem = f"all {MOST_STAGES} stages are in use; try again later"
            await socket.send_text(msgspec.json.encode(StageProblem(problem=problem)).decode())
            await socket.close(1013)
            return
        self._stages += 1
        stage = Stage(self._feed(socket).source, _sender(socket, asyncio.get_running_loop()))
        stage.start()
        try:
            await _listen(socket, stage)
        finally:
            stage.close()
            self._stages -= 1  # first: the server may cancel what waits
            await run_in_threadpool(stage.join)


async def _listen(socket: WebSocket, stage: Stage) -> None:
    """Pass on requests until the viewer leaves."""
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
        except (msgspec.ValidationError, msgspec.DecodeError) as error:
            problem = f"invalid request: {error}"
        if problem:
            await socket.send_text(msgspec.json.encode(StageProblem(problem=problem)).decode())


#: What sending raises when the socket, the server's end of it, or the loop is no more.
_GONE = (
    RuntimeError, WebSocketDisconnect, TimeoutError, CancelledError,
    anyio.BrokenResourceError, anyio.ClosedResourceError,
)  # fmt: skip

Sender = Callable[[Moment | StageProblem, bytes | None], None]


def _sender(socket: WebSocket, loop: asyncio.AbstractEventLoop) -> Sender:
    """Return what shows a stage's moments; it waits until they are sent."""

    async def send(news: Moment | StageProblem, picture: bytes | None) -> None:
        await socket.send_text(msgspec.json.encode(news).decode())
        if picture is not None:
            await socket.send_bytes(picture)

    def show(news: Moment | StageProblem, picture: bytes | None) -> None:
        sending: Awaitable[None] = asyncio.wait_for(send(news, picture), _SEND_S)
        try:
            asyncio.run_coroutine_threadsafe(sending, loop).result(_SEND_S + 1)  # type: ignore[arg-type]
        except _GONE as error:
            raise ConnectionError(f"the viewer has left: {error}") from error

    return show
