"""What is saved of a result: its files, all of them in one, files for a purpose."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from unips_jax.app import exports
from unips_jax.app.answers import (
    Refused,
    file_answer,
    file_in,
    json_of,
    require_room,
    zipped,
)
from unips_jax.app.desk import Desk
from unips_jax.app.objects import Object, clean

_VIEW = {  # a result's page: its own scripts, and nothing of ours
    "x-frame-options": "SAMEORIGIN",
    "content-security-policy": "sandbox allow-scripts allow-downloads allow-modals; "
    "default-src 'none'; img-src data: blob:; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; frame-ancestors 'self'",
}


class Saving:
    """The addresses of an object's result."""

    def __init__(self, desk: Desk) -> None:
        """Exports are made by the desk's processes."""
        self._desk = desk

    def routes(self) -> list[tuple[str, str, Callable[..., Any]]]:
        """Methods, paths below an object's, and what answers."""
        return [
            ("GET", "/results/{name}", self.result),
            ("GET", "/zip/{name}", self.zip),
            ("POST", "/exports", self.export),
            ("GET", "/exports/{name}", self.exported),
        ]

    async def result(self, request: Request, item: Object) -> Response:
        """A file of the results; ?save: to be stored."""
        name = request.path_params["name"]
        path = file_in(Path(item.target), name) if item.state == "done" else None
        headers = _VIEW if name.endswith(".html") else {}
        saved = f"{clean(item.name, longest=60)}-{name}"
        return file_answer(
            path, saved if "save" in request.query_params else None, headers
        )

    async def zip(self, request: Request, item: Object) -> Response:
        """All results in one file."""
        if item.state != "done":
            raise Refused(404, "gone")
        path = await asyncio.to_thread(zipped, item)
        return file_answer(path, f"{Path(item.target).name}.zip")

    async def export(self, request: Request, item: Object) -> Response:
        """Makes a file from JSON, `exports.Wanted`; gives its name, size and unit."""
        if item.state != "done":
            raise Refused(404, "gone")
        asked = await json_of(request)
        try:
            wanted = exports.wanted(asked)
        except (ValueError, TypeError):
            raise Refused(422, "length") from None
        require_room(item.folder)
        return JSONResponse(await self._desk.make_export(item, wanted))

    async def exported(self, request: Request, item: Object) -> Response:
        """A file that was made, to be stored."""
        name = request.path_params["name"]
        return file_answer(file_in(item.exports, name), name)
