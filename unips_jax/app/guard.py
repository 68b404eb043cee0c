"""Who may ask: no other site, by whatever name; and no more than the server takes."""

import ipaddress
import json
import socket
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

_Scope = MutableMapping[str, Any]
_Send = Callable[[_Scope], Awaitable[None]]
_Receive = Callable[[], Awaitable[_Scope]]

_HEADERS = {
    b"x-content-type-options": b"nosniff",
    b"referrer-policy": b"no-referrer",
    b"cross-origin-resource-policy": b"same-origin",
    b"cross-origin-opener-policy": b"same-origin",
    b"x-frame-options": b"DENY",
    b"cache-control": b"no-store",
    b"content-security-policy": b"default-src 'none'; script-src 'self'; "
    b"style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; "
    b"frame-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
}
"""Of every answer that doesn't have its own."""

_REFUSED = {
    400: b"this address is not the application's own",
    403: b"other sites may not use the application",
    411: b"expected an upload of announced length",
    413: b"the upload is too large",
}


def _json(code: str, values: dict[str, int]) -> bytes:
    return json.dumps({"code": code, "values": values}).encode()


def is_loopback(host: str) -> bool:
    """Whether an address is this machine's alone."""
    address = _address(host.strip("[]"))
    return host.lower() == "localhost" if address is None else address.is_loopback


class Guard:
    """Middleware: refuses before anything is read, and completes the headers."""

    def __init__(
        self, app: Callable[..., Awaitable[None]], *, host: str, body_bytes: int
    ) -> None:
        self._app = app
        self._host = host.lower()
        self._names = {self._host, "localhost"}
        if not is_loopback(host):
            self._names |= {socket.gethostname().lower(), socket.getfqdn().lower()}
        self._limit = body_bytes

    async def __call__(self, scope: _Scope, receive: _Receive, send: _Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":  # there are no sockets here
            await send({"type": "websocket.close", "code": 1008})
            return

        async def sent(message: _Scope) -> None:
            if message["type"] == "http.response.start":
                headers = list(message.get("headers", []))
                there = {name.lower() for name, _ in headers}
                headers += [(k, v) for k, v in _HEADERS.items() if k not in there]
                message = {**message, "headers": headers}
            await send(message)

        status = self._status(scope["method"], dict(scope["headers"]))
        if status is None:
            await self._app(scope, receive, sent)
            return
        kind, body = b"text/plain", _REFUSED[status]
        if status == 413:  # which the page says in its language
            limit = {"most": self._limit // 10**6}
            kind, body = b"application/json", _json("too_large", limit)
        headers = [(b"content-type", kind), (b"connection", b"close")]
        start = {"type": "http.response.start", "status": status, "headers": headers}
        await sent(start)
        await sent({"type": "http.response.body", "body": body})

    def _status(self, method: str, headers: dict[bytes, bytes]) -> int | None:
        host = headers.get(b"host", b"").decode("latin-1").lower()
        if not self._knows(_without_port(host)):
            return 400
        if not _same_site(headers, host):
            return 403
        if method in ("GET", "HEAD"):
            return None
        length = headers.get(b"content-length", b"")
        # In chunks a body may be longer than it announces.
        if not length.isdigit() or b"transfer-encoding" in headers:
            return 411
        return 413 if int(length) > self._limit else None

    def _knows(self, name: str) -> bool:
        """Whether a host's name is ours: another's could lead to us (rebinding)."""
        # Addresses in digits can't be another site's.
        if name in self._names or is_loopback(name):
            return True
        return not is_loopback(self._host) and _address(name) is not None


def _same_site(headers: dict[bytes, bytes], host: str) -> bool:
    """Whether a request comes from our own page, or from the address bar."""
    origin = headers.get(b"origin")
    if origin is not None:
        scheme, _, asking = origin.decode("latin-1").lower().partition("://")
        return scheme in ("http", "https") and asking == host
    site = headers.get(b"sec-fetch-site", b"none")
    if site in (b"none", b"same-origin"):
        return True
    # A link elsewhere may lead to the page, which does nothing by itself.
    return (
        headers.get(b"sec-fetch-mode") == b"navigate"
        and headers.get(b"sec-fetch-dest") == b"document"
    )


def _without_port(host: str) -> str:
    if host.startswith("["):
        return host.partition("]")[0].strip("[]")
    return host.partition(":")[0]


def _address(name: str) -> Any:
    """The address that a name is in digits; None where it is none."""
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None
