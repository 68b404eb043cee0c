"""What the application does with photographs, each call in a `Worker`'s process.

These call what the commands call: `unips_jax.estimation`, `io`, `capture`. Each reports
its progress to `report`, and what can't be done is an `InputError`.
"""

import dataclasses
import functools
import itertools
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from unips_jax.app.small_pictures import (
    PICTURE,
    drawn_mask,
    full_mask,
    thumbnail,
    write_preview,
)
from unips_jax.app.worker import Report
from unips_jax.errors import InputError
from unips_jax.io.door import writing
from unips_jax.io.images import read_image_file, write_image
from unips_jax.io.naming import VIDEO_SUFFIXES
from unips_jax.pictures.maps import shrink

if TYPE_CHECKING:  # what reads photographs is imported when there are some
    from unips_jax.estimation.reading import Looked
    from unips_jax.io.selection import Selection


@dataclasses.dataclass(frozen=True)
class Choices:
    """What the visitor may choose of `FolderOptions`."""

    transfer: str = "auto"
    perspective: bool = False  # focal length of the EXIF data
    register: bool = False
    mesh: bool = True  # GLB, with the object's colours
    fast: bool = False
    lights: bool = False
    base_color: bool = False
    rti: bool = False
    confidence: bool = False


@dataclasses.dataclass(frozen=True)
class Chosen:
    """Files of an object's folder: the photographs, their mask, what is not used."""

    folder: Path
    photographs: tuple[str, ...]
    mask: str | None
    aside: tuple[str, ...]

    def options(self, mask: Any, max_pixels: int, **more: Any) -> Any:
        """`FolderOptions` by which these files and no others are taken."""
        from unips_jax.estimation.options import FolderOptions

        if mask == "auto" and self.mask:
            mask = self.folder / self.mask
        return FolderOptions(
            mask=mask,
            include=self.photographs,
            exclude=self.aside,
            max_pixels=max_pixels,
            **more,
        )


def look(
    photograph: Path, small: Path, max_pixels: int, *, report: Report
) -> dict[str, Any]:
    """The facts of a photograph, which is decoded; writes a small picture of it.

    Of a video or a TIFF of several pages the "frames": files that take its place.
    """
    from unips_jax.capture.unpack import is_container

    if is_container(photograph):
        frames = _unpack(photograph, max_pixels)
        if frames:
            return {"frames": frames}
    file = read_image_file(photograph, max_pixels=max_pixels)
    transfer = file.encoding.transfer
    write_image(small, thumbnail(file.pixels, transfer))
    return {
        "width": file.header.width,
        "height": file.header.height,
        "type": str(file.pixels.dtype),
        "transfer": transfer,
    }


def _unpack(container: Path, max_pixels: int) -> list[str]:
    """Puts a file's frames next to it; gives their names, none for a plain TIFF."""
    from unips_jax.capture.unpack import unpacked

    try:
        with unpacked(container, max_pixels=max_pixels) as folder:
            files = sorted(folder.iterdir())
            names = _frame_names(container, [file.name for file in files])
            for file, name in zip(files, names, strict=True):
                with writing(container):
                    shutil.move(file, container.with_name(name))  # from another disk
    except InputError:
        if container.suffix.lower() in VIDEO_SUFFIXES:
            raise
        return []  # one photograph, or damaged: its reader says what is wrong
    return names


def _frame_names(container: Path, frames: list[str]) -> list[str]:
    """Names of a file's frames next to it, with a number if others have them."""
    taken = {path.name.lower() for path in container.parent.iterdir()}
    for number in itertools.count(1):
        stem = container.stem if number == 1 else f"{container.stem}-{number}"
        names = [f"{stem}_{name}" for name in frames]
        if taken.isdisjoint(name.lower() for name in names):
            break
    return names


def gather(
    chosen: Chosen,
    pictures: Path,
    options: dict[str, Any],
    max_pixels: int,
    *,
    report: Report,
) -> dict[str, Any]:
    """Reads the photographs together, and looks for what is wrong with them.

    What can't be used with the others is left out. `pictures` receives `picture.jpg`,
    to draw the mask over, and `mask.png`, of its size, if one is given or suggested.
    Options are those of `FolderOptions`: transfer, register.
    """
    from unips_jax.capture.masks import mask_picture

    report("reading", 0.0)
    selection, looked, refused = _read_together(chosen, options, max_pixels)
    capture, mask_from = looked.capture, "file"
    if selection.mask_file is None:
        mask_from = "suggested" if looked.facts["mask_suggested"] else "none"
    picture = shrink(mask_picture(capture.images, transfer=capture.transfer), PICTURE)
    write_image(pictures / "picture.jpg", picture)
    if mask_from != "none":
        small = cv2.resize(255 * capture.mask.astype(np.uint8), picture.shape[1::-1])
        _write_mask(pictures / "mask.png", small > 127)
    same = [
        name
        for reason, names in selection.left_out.items()
        for name in names
        if name in chosen.photographs and reason.startswith("the same")
    ]
    height, width = capture.mask.shape
    return {
        "names": list(selection.names),
        "refused": refused,
        "same": same,
        "width": width,
        "height": height,
        "transfer": capture.transfer,
        "focal": capture.focal,
        "mask": mask_from,
        "findings": looked.facts["findings"],
    }


def _read_together(
    chosen: Chosen, options: dict[str, Any], max_pixels: int
) -> tuple["Selection", "Looked", dict[str, str]]:
    """What can be used together, and of the others each one's reason why not."""
    from unips_jax.estimation.reading import chosen_photographs, read_and_look
    from unips_jax.io.record import HashingReader

    given, refused, odd = chosen, dict[str, str](), dict[str, str]()
    while True:
        how = chosen.options("auto", max_pixels, **options)
        selection = chosen_photographs(chosen.folder, how)
        reader = HashingReader(max_pixels)
        try:
            looked = read_and_look(selection, how, reader, verbose=False)
            return selection, looked, refused | odd
        except InputError as error:
            name, text = _culprit(chosen, str(error))
            if name is None or (name != chosen.mask and len(selection.files) < 2):
                raise
            refused[name] = text
            chosen = _without(chosen, name)
            first = selection.names[0]
            if _most_differ(first, refused, given):
                odd[first] = f"most others are not like it: {text}"
                chosen = given = _without(given, first)
                refused = {}


def _culprit(chosen: Chosen, text: str) -> tuple[str | None, str]:
    """The file that an error names, and the rest of the error."""
    for name in (*chosen.photographs, *([chosen.mask] if chosen.mask else [])):
        start = f"{chosen.folder / name}: "
        if text.startswith(start):
            return name, text.removeprefix(start)
    return None, text


def _most_differ(first: str, refused: dict[str, str], given: Chosen) -> bool:
    """Whether most photographs are refused for being unlike the first."""
    # Errors end in "... as NAME", or "... as in NAME", of what they compare with.
    like = re.compile(rf" as (?:in )?{re.escape(first)}[ ,]")
    unlike = [n for n, text in refused.items() if n != given.mask and like.search(text)]
    return 2 * len(unlike) > len(given.photographs)


def _without(chosen: Chosen, name: str) -> Chosen:
    return Chosen(
        chosen.folder,
        tuple(n for n in chosen.photographs if n != name),
        None if name == chosen.mask else chosen.mask,
        (*chosen.aside, name),
    )


def cut(picture: Path, box: Sequence[float], target: Path, *, report: Report) -> None:
    """Finds the object in a box (left, top, right, bottom; pixels), by GrabCut."""
    from unips_jax.capture.grabcut import grabcut_mask

    mask = grabcut_mask(read_image_file(picture).pixels, box=tuple(box))
    _write_mask(target, mask)


def piece(
    picture: Path,
    drawn: Path,
    point: tuple[float, float],
    target: Path,
    *,
    report: Report,
) -> None:
    """Takes the piece at a point of the picture into the drawn mask, or drops it."""
    from unips_jax.capture.masks import toggle_piece

    pixels = read_image_file(picture).pixels
    mask = drawn_mask(drawn, pixels.shape)
    _write_mask(target, toggle_piece(mask, pixels, point))


def _write_mask(path: Path, mask: np.ndarray) -> None:
    write_image(path, 255 * mask.astype(np.uint8))


@functools.lru_cache(maxsize=1)
def _network(weights: str) -> Any:
    from unips_jax.console import start_jax
    from unips_jax.estimation.folders import load_network

    start_jax()
    return load_network(weights)


def warm(weights: str, count: int, *, report: Report) -> None:
    """Loads the network, and compiles it for a number of photographs."""
    from unips_jax.estimation.streaming import estimate_photographs

    network = _network(weights)
    images = np.full((count, 16, 16, 3), 100, np.uint8)
    images[:, :8] = 200
    mask = np.ones((16, 16), bool)
    estimate_photographs(network.network, images, mask)


def estimate(
    chosen: Chosen,
    target: Path,
    mask: Path | str,
    preview: Path,
    choices: Choices,
    weights: str,
    max_pixels: int,
    *,
    report: Report,
) -> list[dict[str, Any]]:
    """Estimates normals, depth, mesh and page, as `unips estimate` does.

    The mask is "auto", "none", or the drawn one, white on the object, of any size;
    `preview` receives a picture of coarse normals while the rest is done. Returns what
    was found wrong with the photographs.
    """
    from unips_jax.estimation.folders import estimate_folder

    report("starting", 0.0)
    if isinstance(mask, Path):
        full = mask.with_name("mask-full.png")
        first = chosen.folder / chosen.photographs[0]
        _write_mask(full, full_mask(mask, first, max_pixels))
        mask = full
    given = dataclasses.asdict(choices)
    given["mesh"] = "glb" if given["mesh"] else None
    given["focal"] = "exif" if given.pop("perspective") else None
    options = chosen.options(mask, max_pixels, depth=True, view=True, **given)
    network = _network(weights)
    report("reading", 0.0)

    def progress(done: int, total: int) -> None:
        phase = "normals" if 0 < done < total else "surface" if done else "encoding"
        report(phase, done / max(total, 1))

    record = estimate_folder(
        chosen.folder,
        target,
        network,
        options,
        on_progress=progress,
        on_preview=lambda normals: write_preview(preview, normals),
    )
    return list(record["findings"])
