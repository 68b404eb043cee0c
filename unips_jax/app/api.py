"""The addresses of the page's requests: JSON, photographs, masks, results."""

import asyncio
import dataclasses
import hmac
import os
import shutil
import time
import zipfile
from collections.abc import Awaitable, Callable
from importlib import resources
from pathlib import Path
from typing import Any

from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from unips_jax.app import work
from unips_jax.app.desk import Desk
from unips_jax.app.objects import OVER, Object, Photograph, clean, unused
from unips_jax.app.sorting import use
from unips_jax.errors import InputError
from unips_jax.io.naming import VIDEO_SUFFIXES
from unips_jax.io.results import RECORD
from unips_jax.io.selection import SUFFIXES

_PNG = b"\x89PNG\r\n\x1a\n"
_MASK_BYTES, _JSON_BYTES = 8_000_000, 100_000
_ROOM = 300_000_000  # bytes of the disk that stay free
_VIEW = {  # a result's page: its own scripts, and nothing of ours
    "x-frame-options": "SAMEORIGIN",
    "content-security-policy": "sandbox allow-scripts allow-downloads; "
    "default-src 'none'; img-src data: blob:; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; frame-ancestors 'self'",
}


class Refused(Exception):
    """A request that can't be done; `code` is one of `strings.json`."""

    def __init__(self, status: int, code: str, **values: Any) -> None:
        """Values are for the gaps of the code's text."""
        super().__init__(code)
        self.answer = JSONResponse({"code": code, "values": values}, status)


class Api:
    """All addresses below `/api`."""

    def __init__(self, desk: Desk, *, key: str, cookie: str) -> None:
        """Who has the key as the cookie sees all objects, others those they know."""
        self._desk, self._objects, self._limits = desk, desk.objects, desk.limits
        self._key, self._cookie = key, cookie

    def routes(self) -> list[Route]:
        """For Starlette."""
        one = "/api/objects/{id}"
        return [
            Route("/api/objects", _answered(self.list), methods=["GET"]),
            Route("/api/objects", _answered(self.begin), methods=["POST"]),
            *(
                Route(one + path, _answered(self._of(handler)), methods=[method])
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
                    ("GET", "/results/{name}", self.result),
                    ("GET", "/zip/{name}", self.zip),
                )
            ),
            Route(
                "/api/objects/{id}/restore", _answered(self.restore), methods=["POST"]
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
            {"objects": [self._short(item) for item in shown], "owner": owner}
        )

    async def begin(self, request: Request) -> Response:
        """A new object; `{"example": true}`: with the photographs that ship."""
        wanted = await _json(request)
        drafts = [i for i in self._objects.all() if i.state not in OVER]
        if len(drafts) >= self._limits.objects:
            raise Refused(409, "too_many_objects", most=self._limits.objects)
        item = self._objects.begin()
        if wanted.get("example") is True:
            item.name = "example"
            sample = resources.files("unips_jax") / "assets/sample/obj000.data"
            for index in range(8):
                name = f"photo_{index + 1}.png"
                data = (sample / f"L_{index:02}.png").read_bytes()
                (item.inbox / name).write_bytes(data)
                item.photographs.append(Photograph(name, name, len(data)))
            item.changed()
        return JSONResponse({"id": item.id})

    async def show(self, request: Request, item: Object) -> Response:
        """All of an object; what waits for the page goes on."""
        self._desk.attend(item)
        shown = self._short(item) | {
            "photographs": [_shown(item, p) for p in item.photographs],
            "version": item.version,
            "ready": item.found_version == item.version and not item.of_state("new"),
            "found": item.found,
            "problem": item.problem,
            "mask": item.mask,
            "options": item.options,
            "error": item.error,
            "findings": item.findings,
            "seconds": item.seconds,
        }
        if item.state == "waiting":
            shown["ahead"] = self._desk.queue.index(item)
        if item.state == "running":
            progress = self._desk.progress
            shown |= {"phase": progress.phase, "share": progress.share}
            shown["left"] = progress.seconds_left
            shown["preview"] = (item.pictures / "preview.png").exists()
        if item.state == "done":
            shown["results"] = _results(item)
            if self.owner(request):
                shown["folder"] = item.target
        return JSONResponse(shown)

    def _short(self, item: Object) -> dict[str, Any]:
        used = item.of_state("used")
        return {
            "id": item.id,
            "name": item.name,
            "state": item.state,
            "time": item.asked or item.created,
            "count": len(used),
            "thumbnail": f"{used[0].file}.jpg" if used and used[0].facts else None,
        }

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
            await _store(request, part, size, self._limits.stalled_s)
            part.rename(item.inbox / file)
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
        if shutil.disk_usage(item.folder).free < size + _ROOM:
            raise Refused(507, "disk_full")

    async def use(self, request: Request, item: Object) -> Response:
        """`{"file": name, "use": bool}`: uses a photograph, or sets it aside."""
        _require_draft(item)
        wanted = await _json(request)
        photo = item.named(str(wanted.get("file")))
        if photo is None:
            raise Refused(404, "gone")
        use(item, photo, wanted.get("use") is True)
        self._desk.attend(item)
        return JSONResponse({})

    async def choose(self, request: Request, item: Object) -> Response:
        """The draft's name and options."""
        _require_draft(item)
        wanted = await _json(request)
        before = item.options.get("transfer", "auto")
        item.name = str(wanted.get("name", item.name))[:100] or "object"
        item.options = dataclasses.asdict(_choices(wanted.get("options")))
        if item.options["transfer"] != before:
            item.changed()
        item.save()
        return JSONResponse({})

    async def picture(self, request: Request, item: Object) -> Response:
        """A picture made from the photographs."""
        name = request.path_params["name"]
        if name == "drawn.png":
            return _file(item.drawn if item.drawn.exists() else None)
        return _file(_in(item.pictures, name))

    async def draw(self, request: Request, item: Object) -> Response:
        """The mask that was drawn; ?kind=auto, drawn, whole or empty."""
        _require_draft(item)
        kind = request.query_params.get("kind")
        if kind not in ("auto", "drawn", "whole", "empty"):
            raise Refused(422, "failed")
        data = await _body(request, _MASK_BYTES)
        if kind != "auto":
            if not data.startswith(_PNG):
                raise Refused(415, "failed")
            part = item.drawn.with_suffix(".part")
            part.write_bytes(data)
            part.rename(item.drawn)
        item.mask = kind
        item.save()
        return JSONResponse({})

    async def cut(self, request: Request, item: Object) -> Response:
        """`{"box": [left, top, right, bottom]}`: the object in a box."""
        left, top, right, bottom = map(float, (await _json(request))["box"])
        try:
            await self._desk.cut(item, (left, top, right, bottom))
        except InputError:
            raise Refused(422, "box") from None
        return JSONResponse({})

    async def piece(self, request: Request, item: Object) -> Response:
        """`{"point": [x, y]}`: takes or drops what is connected there."""
        x, y = map(float, (await _json(request))["point"])
        await self._desk.piece(item, (x, y))
        return JSONResponse({})

    async def estimate(self, request: Request, item: Object) -> Response:
        """`{"name": ..., "options": {...}}`: into the list of estimates."""
        wanted = await _json(request)
        options = _choices(wanted.get("options"))
        self._desk.estimate(item, str(wanted.get("name", "")), options)
        return JSONResponse({})

    async def cancel(self, request: Request, item: Object) -> Response:
        """Ends the estimate."""
        self._desk.cancel(item)
        return JSONResponse({})

    async def again(self, request: Request, item: Object) -> Response:
        """To be changed and estimated again: itself, or a new one beside a result."""
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

    async def result(self, request: Request, item: Object) -> Response:
        """A file of the results; ?save: to be stored."""
        name = request.path_params["name"]
        path = _in(Path(item.target), name) if item.state == "done" else None
        headers = _VIEW if name.endswith(".html") else {}
        saved = f"{clean(item.name, longest=60)}-{name}"
        return _file(path, saved if "save" in request.query_params else None, headers)

    async def zip(self, request: Request, item: Object) -> Response:
        """All results in one file."""
        if item.state != "done":
            raise Refused(404, "gone")
        path = await asyncio.to_thread(_zipped, item)
        return _file(path, f"{Path(item.target).name}.zip")


def _answered(
    handler: Callable[[Request], Awaitable[Response]],
) -> Callable[[Request], Awaitable[Response]]:
    """Every failure is an answer of one line."""

    async def answer(request: Request) -> Response:
        try:
            return await handler(request)
        except Refused as refused:
            return refused.answer
        except ClientDisconnect:
            return Response(status_code=400)
        except InputError as error:
            return JSONResponse({"error": str(error)}, 422)
        except OSError as error:
            code = "disk_full" if error.errno in _FULL else "not_stored"
            return JSONResponse({"code": code, "values": {}}, 507)
        except (ValueError, TypeError, KeyError):
            return JSONResponse({"code": "failed", "values": {}}, 422)

    return answer


_FULL = (28, 122)  # ENOSPC, EDQUOT


async def _body(request: Request, most: int) -> bytes:
    data = b""
    async for part in request.stream():
        data += part
        if len(data) > most:
            raise Refused(413, "failed")
    return data


async def _json(request: Request) -> dict[str, Any]:
    import json

    wanted = json.loads(await _body(request, _JSON_BYTES) or b"{}")
    if not isinstance(wanted, dict):
        raise Refused(422, "failed")
    return wanted


async def _store(request: Request, path: Path, size: int, stalled_s: float) -> None:
    """Writes a request's body to a file as it comes."""
    stream = request.stream().__aiter__()
    length = 0
    with path.open("wb") as file:
        while True:
            try:
                part = await asyncio.wait_for(anext(stream), stalled_s)
            except StopAsyncIteration:
                break
            except TimeoutError:
                raise Refused(408, "lost") from None
            length += len(part)
            file.write(part)
    if length != size:
        raise Refused(400, "lost")


def _require_draft(item: Object) -> None:
    if item.state != "draft":
        raise Refused(409, "failed")


def _choices(wanted: Any) -> work.Choices:
    """Options as asked for; what is unknown or of another type is left out."""
    default = work.Choices()
    given = wanted if isinstance(wanted, dict) else {}
    known = {name: value for name, value in dataclasses.asdict(default).items()}
    for name, value in known.items():
        if isinstance(given.get(name), type(value)):
            known[name] = given[name]
    if known["transfer"] not in ("auto", "linear", "srgb"):
        known["transfer"] = "auto"
    return work.Choices(**known)


def _shown(item: Object, photo: Photograph) -> dict[str, Any]:
    return {
        "file": photo.file,
        "name": photo.name,
        "state": photo.state,
        "why": photo.why,
        "detail": photo.detail,
        "picture": bool(photo.facts),
    }


def _results(item: Object) -> list[dict[str, Any]]:
    """The files that the record names, and itself; empty if they are gone."""
    target = Path(item.target)
    try:
        return [
            {"name": file.name, "bytes": file.stat().st_size}
            for file in sorted(target.iterdir())
            if file.is_file() and not file.name.startswith(".")
        ]
    except OSError:
        return []


def _zipped(item: Object) -> Path:
    """All results in one file, made when first asked for."""
    target = Path(item.target)
    path = item.folder / "results.zip"
    made = target / RECORD
    if not path.exists() or path.stat().st_mtime < made.stat().st_mtime:
        part = path.with_suffix(f".{time.monotonic_ns()}.part")
        try:
            with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as z:
                for file in sorted(target.iterdir()):
                    z.write(file, f"{target.name}/{file.name}")
            part.rename(path)
        finally:
            part.unlink(missing_ok=True)
    return path


def _in(folder: Path, name: str) -> Path | None:
    """A plain file of a folder; None where there is none of that name."""
    try:
        entries = [e for e in os.scandir(folder) if e.name == name]
    except OSError:
        return None
    plain = [e for e in entries if e.is_file(follow_symlinks=False)]
    return Path(plain[0].path) if plain else None


def _file(
    path: Path | None, name: str | None = None, headers: dict[str, str] | None = None
) -> Response:
    if path is None:
        raise Refused(404, "gone")
    return FileResponse(path, filename=name, headers=headers)
