"""What visitors may use: bytes, files, memory."""

import contextlib
import dataclasses
import os
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

_Scope = MutableMapping[str, Any]
_Send = Callable[[_Scope], Awaitable[None]]
_Receive = Callable[[], Awaitable[_Scope]]


@dataclasses.dataclass(frozen=True)
class Limits:
    """Bounds on what one server takes.

    Attributes:
        file_bytes: of an uploaded file.
        object_bytes: of all photographs of an object.
        files: photographs of an object.
        objects: in a visitor's list.
        visitors: at a time.
        pixels: of a photograph.
        reading_bytes: memory of the process that reads photographs, all in all.
        estimating_bytes: of the one that estimates.
    """

    file_bytes: int = 200_000_000
    object_bytes: int = 4_000_000_000
    files: int = 200
    objects: int = 50
    visitors: int = 16
    pixels: int = 100_000_000
    reading_bytes: int = 8 * 2**30
    estimating_bytes: int = 0

    def __post_init__(self) -> None:
        """The estimate may have nine tenths of the machine's memory."""
        if self.estimating_bytes == 0:
            with contextlib.suppress(ValueError, OSError, AttributeError):
                there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
                object.__setattr__(self, "estimating_bytes", there * 9 // 10)


def limit_memory(limit: int) -> None:
    """Bounds this process' memory; what asks for more fails, and nothing else does.

    Args:
        limit: in bytes, of data (what is allocated, not what is mapped); 0 for none.
            Where the system knows no such limit, there is none.
    """
    if not limit:
        return
    try:
        import resource  # not on Windows
    except ImportError:
        return
    with contextlib.suppress(ValueError, OSError):
        _, most = resource.getrlimit(resource.RLIMIT_DATA)
        if most != resource.RLIM_INFINITY:
            limit = min(limit, most)
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))


class BodyLimit:
    """Middleware: refuses requests whose bodies are too large, before reading them."""

    def __init__(self, app: Callable[..., Awaitable[None]], limit: int) -> None:
        """Wraps an application.

        Args:
            app: ASGI application.
            limit: of a body, in bytes.
        """
        self._app = app
        self._limit = limit

    async def __call__(self, scope: _Scope, receive: _Receive, send: _Send) -> None:
        """Handles a request."""
        status = self._status(scope)
        if status is None:
            await self._app(scope, receive, send)
            return
        start = {"type": "http.response.start", "status": status, "headers": []}
        await send(start)
        await send({"type": "http.response.body", "body": b"the upload is too large"})

    def _status(self, scope: _Scope) -> int | None:
        if scope["type"] != "http" or scope["method"] in ("GET", "HEAD", "OPTIONS"):
            return None
        headers = dict(scope["headers"])
        length = headers.get(b"content-length", b"")
        if not length.isdigit():
            return 411  # the server holds a body to the length that it announces
        return 413 if int(length) > self._limit else None
