"""The web server of the page: hands messages and pictures on, and keeps strangers out. No torch, no NumPy."""

import asyncio
import contextlib
import ipaddress
import socket
from collections.abc import AsyncIterator
from importlib.resources import files
from urllib.parse import urlsplit

import uvicorn
from plotly.offline import get_plotlyjs
from starlette.applications import Starlette
from starlette.requests import HTTPConnection, Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from lerobot_swr.interactive.hub import MAX_PAGES, Hub, Page
from lerobot_swr.interactive.messages import MAX_MESSAGE_BYTES

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
        "connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",  # another page must not lay this one under its own buttons
    "Cache-Control": "no-store",
}
PAGES = {
    "/": ("page.html", "text/html"),
    "/page.js": ("page.js", "text/javascript"),
    "/page.css": ("page.css", "text/css"),
}


def make_app(hub: Hub, host: str) -> Starlette:
    """The application.

    Args:
        hub: What the page talks to.
        host: Address that the server listens on; pages that were fetched under it are let in.
    """
    plotly = get_plotlyjs()

    async def show(request: Request) -> Response:
        if not _is_own_name(request, host):
            return PlainTextResponse("this server is not meant under that name", 421, HEADERS)
        if request.url.path == "/plotly.js":
            return Response(plotly, 200, HEADERS, "text/javascript")
        name, kind = PAGES[request.url.path]
        text = files("lerobot_swr.interactive").joinpath(name).read_text(encoding="utf-8")
        return Response(text, 200, HEADERS, kind)

    async def talk(websocket: WebSocket) -> None:
        if not (_is_own_name(websocket, host) and _is_same_origin(websocket)):
            await websocket.send_denial_response(
                PlainTextResponse("only the page of this server may connect", 403)
            )
            return
        await websocket.accept()
        page = Page(tab=websocket.query_params.get("tab", "")[:64] or str(id(websocket)))
        if not hub.join(page):
            await websocket.send_json(
                {"type": "error", "message": f"{MAX_PAGES} pages are open already; close one", "fatal": True}
            )
            await websocket.close(1013, "too many pages")
            return
        speaking = asyncio.create_task(_speak(websocket, page))
        try:
            await _listen(websocket, hub, page)
        finally:
            hub.leave(page)
            page.close()
            await asyncio.gather(speaking, return_exceptions=True)

    @contextlib.asynccontextmanager
    async def life(app: Starlette) -> AsyncIterator[None]:
        hub.start()
        yield
        hub.stop()

    routes = [Route(path, show) for path in (*PAGES, "/plotly.js")]
    return Starlette(routes=[*routes, WebSocketRoute("/ws", talk)], lifespan=life)


async def _listen(websocket: WebSocket, hub: Hub, page: Page) -> None:
    """Until the page goes."""
    with contextlib.suppress(WebSocketDisconnect):
        while not page.is_closed:
            message = await websocket.receive()
            if message["type"] == "websocket.disconnect":
                return
            text = message.get("text")
            hub.hear_page(page, message.get("bytes") if text is None else text)


async def _speak(websocket: WebSocket, page: Page) -> None:
    """Tell a page its news, and of pictures the newest only."""
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        while True:
            await page.has_news.wait()
            page.has_news.clear()
            while page.events:
                await websocket.send_text(page.events.popleft())
            frame, page.frame = page.frame, None
            if frame is not None:
                await websocket.send_bytes(frame)
            if page.is_closed:
                if websocket.client_state is WebSocketState.CONNECTED:
                    await websocket.close(4000, "this page is open elsewhere")
                return


def _is_own_name(connection: HTTPConnection, host: str) -> bool:
    """Whether the server was asked under an address or a name that nobody else can make point here."""
    name = urlsplit(f"//{connection.headers.get('host', '')}").hostname or ""
    if name in ("localhost", host):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _is_same_origin(connection: HTTPConnection) -> bool:
    """Whether the page that connects is this server's; programs that are no browsers send no origin."""
    origin = connection.headers.get("origin")
    return origin is None or urlsplit(origin).netloc == connection.headers.get("host")


def bind(host: str, port: int) -> socket.socket:
    """A socket to listen on.

    Raises:
        ValueError: If the address cannot be had.
    """
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family)
    except OSError as error:
        raise ValueError(
            f"host={host!r}, port={port}: cannot listen there ({error.strerror or error}); give another "
            "--port, or 0 for any that is free"
        ) from error


def make_server(config: uvicorn.Config) -> uvicorn.Server:
    """The server, which whoever embeds it may want to hold on to."""
    return uvicorn.Server(config)


def serve(hub: Hub, host: str, listener: socket.socket) -> None:
    """Serve until Ctrl-C.

    Raises:
        ValueError: If the environment, the policy or the dataset cannot be used.
    """
    config = uvicorn.Config(
        make_app(hub, host),
        log_level="warning",
        ws="websockets-sansio",
        ws_max_size=MAX_MESSAGE_BYTES,
        ws_per_message_deflate=False,
        timeout_graceful_shutdown=2,
    )
    server = make_server(config)

    def give_up() -> None:
        server.should_exit = True

    hub.give_up = give_up
    server.run(sockets=[listener])
    if hub.failure is not None:
        raise ValueError(hub.failure)
