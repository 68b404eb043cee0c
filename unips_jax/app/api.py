"""The addresses of the page's requests: JSON, photographs, masks, results."""

import asyncio
import dataclasses
import hmac
import time
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from unips_jax.app import work
from unips_jax.app.answers import (
    Refused,
    answered,
    body_of,
    file_answer,
    file_in,
    json_of,
    require_room,
    store_body,
)
from unips_jax.app.desk import Desk
from unips_jax.app.objects import OVER, Object, Photograph, clean, unused
from unips_jax.app.saving import Saving
from unips_jax.app.shown import short, whole
from unips_jax.app.sorting import use
from unips_jax.errors import InputError
from unips_jax.io.door import move, write_whole
from unips_jax.io.naming import VIDEO_SUFFIXES
from unips_jax.io.selection import SUFFIXES

_PNG = b"\x89PNG\r\n\x1a\n"
_MASK_BYTES = 8_000_000


class Api:
    """All addresses below `/api`."""

    def __init__(self, desk: Desk, *, key: str, cookie: str) -> None:
        """Who has the key as the cookie sees all objects, others those they know."""
        self._desk, self._objects, self._limits = desk, desk.objects, desk.limits
        self._key, self._cookie = key, cookie

    def routes(self) -> list[Route]:
        one = "/api/objects/{id}"
        return [
            Route("/api/objects", answered(self.list), methods=["GET"]),
            Route("/api/objects", answered(self.begin), methods=["POST"]),
            *(
                Route(one + path, answered(self._of(handler)), methods=[method])
                for method, path, handler in (
                    ("GET", "", self.show),
                    ("PUT", "/files", self.receive),
                    ("POST", "/use", self.use),
                    ("POST", "/options", self.choose),
                    ("GET", "/pictures/{name}", self.picture),
                    ("PUT", "/mask", self.draw),
                    ("POST", "/cut", self.cut),
                    ("POST", "/piece", self.piece),
                    ("POST", "/estimate", self.estimate),
                    ("POST", "/cancel", self.cancel),
                    ("POST", "/again", self.again),
                    ("POST", "/remove", self.remove),
                    *Saving(self._desk).routes(),
                )
            ),
            Route(
                "/api/objects/{id}/restore", answered(self.restore), methods=["POST"]
            ),
        ]

    def _of(self, handler: Callable[..., Any]) -> Callable[..., Any]:
        async def found(request: Request) -> Response:
            item = self._objects.get(request.path_params["id"])
            if item is None:
                raise Refused(404, "gone")
            return await handler(request, item)

        return found

    def owner(self, request: Request) -> bool:
        """Whether a request has the key that was printed where the server started."""
        given = request.cookies.get(self._cookie, "")
        return hmac.compare_digest(given.encode(), self._key.encode())

    async def list(self, request: Request) -> Response:
        """The objects that the browser may see, in short."""
        known = set(request.query_params.get("ids", "").split(","))
        owner = self.owner(request)
        shown = [i for i in self._objects.all() if owner or i.id in known]
        return JSONResponse(
            {"objects": [short(item) for item in shown], "owner": owner}
        )

    async def begin(self, request: Request) -> Response:
        """A new object, `{"name": text}`; `{"example": true}`: of what ships."""
        wanted = await json_of(request)
        drafts = [i for i in self._objects.all() if i.state not in OVER]
        if len(drafts) >= self._limits.objects:
            raise Refused(409, "too_many_objects", most=self._limits.objects)
        if wanted.get("example") is True:
            sample = resources.files("unips_jax") / "assets/sample/obj000.data"
            photographs = {
                f"photo_{index + 1}.png": (sample / f"L_{index:02}.png").read_bytes()
                for index in range(8)
            }
            item = self._objects.begin("example", photographs)
        else:
            item = self._objects.begin(_name(wanted.get("name")))
        return JSONResponse({"id": item.id})

    async def show(self, request: Request, item: Object) -> Response:
        """All of an object; what waits for the page goes on."""
        self._desk.attend(item)
        return JSONResponse(whole(item, self._desk, owner=self.owner(request)))

    async def receive(self, request: Request, item: Object) -> Response:
        """One file, as it is."""
        _require_draft(item)
        name = request.query_params.get("name", "")
        size = int(request.headers["content-length"])
        self._check(item, name, size)
        taken = {p.file for p in item.photographs}
        file = unused(clean(name), taken)
        photo = Photograph(file, Path(name).name[:200], size)
        part = item.folder / f"{file}.part"
        self._desk.receiving[item.id] += 1
        item.photographs.append(photo)  # its name is taken from now on
        photo.state = "receiving"
        try:
            await store_body(request, part, size, self._limits.stalled_s)
            move(part, item.inbox / file)
            photo.state = "new"
        except BaseException:
            item.photographs.remove(photo)
            part.unlink(missing_ok=True)
            raise
        finally:
            self._desk.receiving[item.id] -= 1
        self._desk.received(item)
        return JSONResponse({"file": file})

    def _check(self, item: Object, name: str, size: int) -> None:
        limits = self._limits
        suffix = Path(clean(name)).suffix.lower()
        if suffix not in SUFFIXES | VIDEO_SUFFIXES:
            raise Refused(415, "not_an_image")
        if size > limits.file_bytes:
            raise Refused(413, "too_large", most=limits.file_bytes // 10**6)
        if size == 0:
            raise Refused(415, "empty_file")
        if len(item.photographs) >= limits.files:
            raise Refused(409, "too_many", most=limits.files)
        total = sum(p.bytes for p in item.photographs) + size
        if total > limits.object_bytes:
            raise Refused(413, "too_large_together", most=limits.object_bytes // 10**9)
        require_room(item.folder, size)

    async def use(self, request: Request, item: Object) -> Response:
        """`{"file": name, "use": bool}`: uses a photograph, or sets it aside."""
        _require_draft(item)
        wanted = await json_of(request)
        photo = item.named(str(wanted.get("file")))
        if photo is None:
            raise Refused(404, "gone")
        use(item, photo, wanted.get("use") is True)
        self._desk.attend(item)
        return JSONResponse({})

    async def choose(self, request: Request, item: Object) -> Response:
        """The draft's name and options."""
        _require_draft(item)
        wanted = await json_of(request)
        before = item.options.get("transfer", "auto")
        item.name = _name(wanted.get("name", item.name))
        item.options = dataclasses.asdict(_choices(wanted.get("options")))
        if item.options["transfer"] != before:
            item.changed()
        item.save()
        return JSONResponse({})

    async def picture(self, request: Request, item: Object) -> Response:
        """A picture made from the photographs."""
        name = request.path_params["name"]
        if name == "drawn.png":
            return file_answer(item.drawn if item.drawn.exists() else None)
        return file_answer(file_in(item.pictures, name))

    async def draw(self, request: Request, item: Object) -> Response:
        """The mask that was drawn; ?kind=auto, drawn, whole or empty."""
        _require_draft(item)
        kind = request.query_params.get("kind")
        if kind not in ("auto", "drawn", "whole", "empty"):
            raise Refused(422, "failed")
        data = await body_of(request, _MASK_BYTES)
        if kind != "auto":
            if not data.startswith(_PNG):
                raise Refused(415, "failed")
            write_whole(item.drawn, data)
        item.mask = kind
        item.mask_version += 1
        item.save()
        return JSONResponse({"mask_version": item.mask_version})

    async def cut(self, request: Request, item: Object) -> Response:
        """`{"box": [left, top, right, bottom]}`: the object in a box."""
        left, top, right, bottom = map(float, (await json_of(request))["box"])
        try:
            await self._desk.cut(item, (left, top, right, bottom))
        except InputError:
            raise Refused(422, "box") from None
        return JSONResponse({})

    async def piece(self, request: Request, item: Object) -> Response:
        """`{"point": [x, y]}`: takes or drops what is connected there."""
        x, y = map(float, (await json_of(request))["point"])
        await self._desk.piece(item, (x, y))
        return JSONResponse({})

    async def estimate(self, request: Request, item: Object) -> Response:
        """`{"name": ..., "options": {...}}`: into the list of estimates."""
        wanted = await json_of(request)
        options = _choices(wanted.get("options"))
        self._desk.estimate(item, str(wanted.get("name", "")), options)
        return JSONResponse({})

    async def cancel(self, request: Request, item: Object) -> Response:
        self._desk.cancel(item)
        return JSONResponse({})

    async def again(self, request: Request, item: Object) -> Response:
        """To be changed and estimated again: itself, or a new one next to results."""
        if item.state not in OVER:
            raise Refused(409, "failed")
        if item.state == "done":
            item = await asyncio.to_thread(self._objects.again, item)
        else:
            item.state = "draft"
            item.save()
        return JSONResponse({"id": item.id})

    async def remove(self, request: Request, item: Object) -> Response:
        """Takes an object off the list; results stay in their folder."""
        self._desk.cancel(item)
        item.removed = time.time()
        item.save()
        return JSONResponse({})

    async def restore(self, request: Request) -> Response:
        """Puts a removed object back."""
        item = self._objects.get_removed(request.path_params["id"])
        if item is None:
            raise Refused(404, "gone")
        item.removed = 0.0
        item.save()
        return JSONResponse({})


def _name(wanted: Any) -> str:
    text = wanted if isinstance(wanted, str) else ""
    # Half of a surrogate pair could never be sent back.
    return text.encode(errors="replace").decode()[:100] or "object"


def _require_draft(item: Object) -> None:
    if item.state != "draft":
        raise Refused(409, "failed")


def _choices(wanted: Any) -> work.Choices:
    """Options as asked for; what is unknown or of another type is left out."""
    default = dataclasses.asdict(work.Choices())
    given = wanted if isinstance(wanted, dict) else {}
    known: dict[str, Any] = {
        name: given[name]
        for name, value in default.items()
        if isinstance(given.get(name), type(value))
    }
    if known.get("transfer") not in ("linear", "srgb"):
        known.pop("transfer", None)
    return work.Choices(**known)
