"""The server: its pages, where it listens, what is closed in the end."""

import contextlib
import errno
import os
import secrets
import socket
import threading
import webbrowser
from collections.abc import AsyncIterator, Iterator
from importlib import resources
from pathlib import Path

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import Route

from unips_jax.app.api import Api
from unips_jax.app.desk import Desk
from unips_jax.app.guard import Guard
from unips_jax.app.limits import Limits
from unips_jax.app.objects import Objects, opened
from unips_jax.errors import InputError
from unips_jax.io.results import clear_leftovers

PORT = 8080
_TRIED = 20  # ports from there, where none was asked for
_USED = (errno.EADDRINUSE, errno.EACCES)  # Windows keeps ranges of ports for itself
_KINDS = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".png": "image/png",
    ".svg": "image/svg+xml",
}


def application(
    objects: Objects,
    *,
    host: str,
    port: int,
    key: str,
    weights: str = "tiny",
    limits: Limits | None = None,
) -> Starlette:
    """The application, for an ASGI server that listens there."""
    limits = limits or Limits()
    cookie = f"unips-{port}"  # cookies don't know of ports

    @contextlib.asynccontextmanager
    async def living(app: Starlette) -> AsyncIterator[None]:
        desk = Desk(objects, limits, weights)
        app.router.routes += Api(desk, key=key, cookie=cookie).routes()
        desk.start()
        desk.warm(8)
        yield
        await desk.close()

    async def index(request: Request) -> Response:
        given = request.query_params.get("key")
        if given is None:
            return _asset("index.html")
        answer = RedirectResponse("/", 303)
        if secrets.compare_digest(given.encode(), key.encode()):
            answer.set_cookie(cookie, key, httponly=True, samesite="strict")
        return answer

    async def asset(request: Request) -> Response:
        return _asset(request.path_params["name"])

    return Starlette(
        routes=[Route("/", index), Route("/assets/{name}", asset)],
        middleware=[
            Middleware(Guard, host=host, body_bytes=limits.file_bytes + 1_000_000)
        ],
        lifespan=living,
    )


def _asset(name: str) -> Response:
    kind = _KINDS.get(Path(name).suffix)
    folder = resources.files("unips_jax.app") / "assets"
    found = {asset.name: asset for asset in folder.iterdir()}.get(name)
    if found is None or kind is None:
        return Response("there is no such file", 404)
    return Response(found.read_bytes(), media_type=kind)


def serve(
    host: str,
    port: int | None,
    *,
    results: Path,
    show: bool,
    weights: str = "tiny",
) -> None:
    """Serves the application until it is interrupted.

    Without a port it takes 8080, or the next that is free. `InputError` if the port is
    used, or the folder can't be.
    """
    limits = Limits()
    key = secrets.token_urlsafe(18)
    with (
        opened(results, days=limits.draft_days) as objects,
        listening(host, port) as ears,
    ):
        clear_leftovers(results)
        port = ears.getsockname()[1]
        name = f"[{host}]" if ":" in host else host
        address = f"http://{name}:{port}"
        app = application(
            objects, host=host, port=port, key=key, weights=weights, limits=limits
        )
        config = uvicorn.Config(
            app,
            log_level="warning",
            access_log=False,
            server_header=False,
            proxy_headers=False,
            ws="none",
            timeout_graceful_shutdown=3,
            timeout_keep_alive=30,
        )
        print(
            f"{address}/?key={key} (Ctrl-C ends it); results go to {results}",
            flush=True,
        )
        if show:
            opening = threading.Timer(1, webbrowser.open, [f"{address}/?key={key}"])
            opening.daemon = True
            opening.start()
        uvicorn.Server(config).run(sockets=[ears])


@contextlib.contextmanager
def listening(host: str, port: int | None) -> Iterator[socket.socket]:
    """A socket that listens there; `InputError` if it can't."""
    ports = range(PORT, PORT + _TRIED) if port is None else [port]
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    for number in ports:
        ears = socket.socket(family, socket.SOCK_STREAM)
        if os.name != "nt":  # there two could listen
            ears.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            ears.bind((host, number))
            ears.listen(128)
        except OSError as error:
            ears.close()
            if error.errno in _USED and number != ports[-1]:
                continue
            raise InputError(_cannot_listen(host, number, error)) from None
        with ears:
            yield ears
        return


def _cannot_listen(host: str, port: int, error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        return (
            f"--port {port}: expected a free port, got one that another program "
            "listens on; choose another, or leave --port out"
        )
    reason = error.strerror or error
    return f"--host {host} --port {port}: expected an address of this machine: {reason}"
