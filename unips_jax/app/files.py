"""Addresses of visitors' files: what was made from photographs, and results."""

import asyncio
import zipfile
from pathlib import Path

from fastapi import APIRouter, Request
from starlette.responses import FileResponse, PlainTextResponse, Response

from unips_jax.app import work
from unips_jax.app.child import Child
from unips_jax.app.limits import Limits
from unips_jax.app.visitors import Visitor, Visitors
from unips_jax.errors import InputError

_MASK_BYTES = 8_000_000
_PNG = b"\x89PNG\r\n\x1a\n"
_HEADERS = {"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}


def router(visitors: Visitors, limits: Limits) -> APIRouter:
    """The addresses, all below `/files/KEY`: who does not know the key sees nothing.

    Args:
        visitors: who is there.
        limits: bounds.
    """
    routes = APIRouter()

    @routes.get("/files/{key}/{number}/about/{name}")
    def about(key: str, number: int, name: str) -> Response:
        visitor = visitors.get(key)
        if visitor is None or number != visitor.object:
            return _absent()
        return _file(next((p for p in visitor.about.iterdir() if p.name == name), None))

    @routes.put("/files/{key}/{number}/mask")
    async def mask(key: str, number: int, request: Request) -> Response:
        visitor = visitors.get(key)
        if visitor is None or number != visitor.object:
            return _absent()
        data = b""
        async for part in request.stream():
            data += part
            if len(data) > _MASK_BYTES:
                return PlainTextResponse("the mask is too large", 413)
        if not data.startswith(_PNG):
            return PlainTextResponse("expected a PNG", 415)
        (visitor.about / "drawn.png").write_bytes(data)
        return PlainTextResponse("ok")

    @routes.get("/files/{key}/{number}/cut")
    async def cut(
        key: str, number: int, left: float, top: float, right: float, bottom: float
    ) -> Response:
        visitor = visitors.get(key)
        if visitor is None or number != visitor.object:
            return _absent()
        about = visitor.about
        child = Child(
            work.cut,
            *(about / "picture.jpg", (left, top, right, bottom), about / "cut.png"),
            memory=limits.reading_bytes,
        )
        try:
            await visitor.alone(child)
        except InputError as error:
            return PlainTextResponse(str(error), 422)
        return PlainTextResponse("ok")

    @routes.get("/files/{key}/{number}/results/{name}")
    async def result(key: str, number: int, name: str) -> Response:
        visitor = visitors.get(key)
        if visitor is None:
            return _absent()
        if name.endswith(".zip"):
            return _file(await asyncio.to_thread(_zipped, visitor, number), name)
        return _file(visitor.result(number, name))

    return routes


def _zipped(visitor: Visitor, number: int) -> Path | None:
    """All results in one file, made when first asked for."""
    job = visitor.jobs.get(number)
    if job is None or job.state != "done":
        return None
    path = job.target.with_suffix(".zip")
    if not path.exists():
        part = path.with_suffix(".part")
        with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as packed:
            for file in sorted(job.target.iterdir()):
                packed.write(file, f"{job.target.name}/{file.name}")
        part.rename(path)
    return path


def _file(path: Path | None, name: str | None = None) -> Response:
    if path is None:
        return _absent()
    return FileResponse(path, filename=name, headers=_HEADERS)


def _absent() -> Response:
    return PlainTextResponse("there is no such file", 404)
