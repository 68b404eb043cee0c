"""Requests read within bounds, files, and every failure as an answer of one line."""

import asyncio
import json
import os
import shutil
import zipfile
from collections.abc import Awaitable, Callable
from pathlib import Path, PurePath
from typing import Any

from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, Response

from unips_jax.app.objects import Object
from unips_jax.errors import InputError
from unips_jax.io.door import NotWritten, new_file
from unips_jax.io.results import RECORD

_JSON_BYTES = 100_000
_FULL = (28, 122)  # ENOSPC, EDQUOT
_ROOM = 300_000_000  # bytes of the disk that stay free
PLAIN = (  # what errors begin with or name, and the page's words for it
    ("expected a readable image", "damaged"),
    ("out of memory", "too_many_pixels"),
    ("expected at most", "too_many_pixels"),
    ("expected light on the object", "black"),
    ("expected to be done within", "too_slow"),
)
TOO_MUCH = "too_much_together"
_MUCH = (  # what errors of all photographs together name
    "pixels in all photographs",
    "out of memory",
    "fewer or smaller photographs",
)


class Refused(Exception):
    """A request that can't be done; `code` is one of `strings.json`."""

    def __init__(self, status: int, code: str, **values: Any) -> None:
        """Values are for the gaps of the code's text."""
        super().__init__(code)
        self.answer = JSONResponse({"code": code, "values": values}, status)


def answered(
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
        except (OSError, NotWritten) as error:
            code = "disk_full" if error.errno in _FULL else "not_stored"
            return JSONResponse({"code": code, "values": {}}, 507)
        except InputError as error:
            return JSONResponse({"error": str(error)}, 422)
        except (ValueError, TypeError, KeyError, RecursionError):
            return JSONResponse({"code": "failed", "values": {}}, 422)

    return answer


async def body_of(request: Request, most: int) -> bytes:
    """A request's body of at most this many bytes."""
    data = b""
    async for part in request.stream():
        data += part
        if len(data) > most:
            raise Refused(413, "failed")
    return data


async def json_of(request: Request) -> dict[str, Any]:
    """The JSON object that a request holds; empty if it holds nothing."""
    wanted = json.loads(await body_of(request, _JSON_BYTES) or b"{}")
    if not isinstance(wanted, dict):
        raise Refused(422, "failed")
    return wanted


async def store_body(request: Request, path: Path, size: int, stalled_s: float) -> None:
    """Writes a request's body to a file as it comes."""
    stream = request.stream().__aiter__()
    length = 0
    with new_file(path) as file:
        while True:
            try:
                part = await asyncio.wait_for(anext(stream), stalled_s)
            except StopAsyncIteration:
                break
            except TimeoutError:
                raise Refused(408, "lost") from None
            length += len(part)
            if length > size:
                raise Refused(400, "lost")
            file.write(part)
    if length != size:
        raise Refused(400, "lost")


def require_room(folder: Path, size: int = 0) -> None:
    """Refuses what would fill the disk."""
    if shutil.disk_usage(folder).free < size + _ROOM:
        raise Refused(507, "disk_full")


def zipped(item: Object) -> Path:
    """All results in one file, made again where the folder changed since."""
    target = Path(item.target)
    path = item.folder / "results.zip"
    # The folder's own time tells of files that went.
    there = (target / RECORD, target, *target.iterdir())
    changed = max(file.stat().st_ctime for file in there)
    if not path.exists() or path.stat().st_ctime < changed:
        with (
            new_file(path) as new,
            zipfile.ZipFile(
                new,
                "w",
                zipfile.ZIP_DEFLATED,
                compresslevel=1,
                strict_timestamps=False,  # files of before 1980 are packed, too
            ) as z,
        ):
            for file in sorted(target.iterdir()):
                z.write(file, f"{target.name}/{file.name}")
    return path


def file_in(folder: Path, name: str) -> Path | None:
    """A plain file of a folder; None where there is none of that name."""
    try:
        entries = [e for e in os.scandir(folder) if e.name == name]
    except OSError:
        return None
    plain = [e for e in entries if e.is_file(follow_symlinks=False)]
    return Path(plain[0].path) if plain else None


def file_answer(
    path: Path | None, name: str | None = None, headers: dict[str, str] | None = None
) -> Response:
    """A file, to be saved if it has a name."""
    if path is None:
        raise Refused(404, "gone")
    return FileResponse(path, filename=name, headers=headers)


def reason_of(text: str, other: str = "unreadable") -> tuple[str, str]:
    """The page's word for why a file is set aside, and the detail where it has none."""
    plain = next((why for part, why in PLAIN if part in text), None)
    return (plain, "") if plain else (other, text)


def problem_of(text: str) -> str:
    """The page's word for what is wrong with all photographs, or the text itself."""
    return TOO_MUCH if any(part in text for part in _MUCH) else text


def without_folder(text: str, path: PurePath) -> str:
    """Errors name files by this machine's folders, which say nothing to visitors."""
    for known in (path, path.parent):
        for end in (": ", "/", "\\"):
            text = text.replace(f"{known}{end}", "")
    return text.replace(str(path), path.name)
