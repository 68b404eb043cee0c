"""What the application does with photographs, each in a process of its own.

These call what the commands call: `unips_jax.estimation.folders`, `io`, `capture`.
"""

import dataclasses
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from unips_jax.app.child import Report
from unips_jax.errors import InputError
from unips_jax.io.color import Transfer, as_linear, srgb_encode
from unips_jax.io.images import read_image_file, write_image
from unips_jax.io.selection import select

_THUMBNAIL, _PICTURE = 160, 1024
_DRAWN_BYTES = 8_000_000
RESULT_FILES = (
    "view.html",
    "normals.png",
    "normals.npy",
    "depth.exr",
    "depth.png",
    "height.png",
    "mesh.glb",
    "sheet.png",
    "normals.json",
)


@dataclasses.dataclass(frozen=True)
class Choices:
    """What the visitor chose.

    Attributes:
        transfer: how photographs encode light.
        perspective: depth as of a camera with the focal length of the EXIF data.
        mask: "drawn": the picture that was drawn; "none": the whole image.
        mesh: also a mesh.
    """

    transfer: str = "auto"
    perspective: bool = False
    mask: str = "drawn"
    mesh: bool = True


def inspect(
    folder: Path, about: Path, max_pixels: int, *, report: Report
) -> dict[str, Any]:
    """Reads photographs, and tells what is in them.

    Args:
        folder: of the photographs.
        about: folder for pictures: `thumbnail-0.jpg`, ..., `picture.jpg` to draw the
            mask over, and `mask.png`, of its size, if one is given or suggested.
        max_pixels: of a photograph.
        report: of progress.

    Returns:
        Names, size, transfer and its reason, focal length, and where the mask is from.

    Raises:
        InputError: if they cannot be used.
    """
    from unips_jax.capture.masks import mask_picture
    from unips_jax.estimation.options import FolderOptions
    from unips_jax.estimation.reading import chosen_photographs, read_and_look
    from unips_jax.io.record import HashingReader

    report("reading", 0.0)
    options = FolderOptions(max_pixels=max_pixels)
    selection = chosen_photographs(folder, options)
    reader = HashingReader(max_pixels)
    looked = read_and_look(selection, options, reader, verbose=False)
    capture, mask_from = looked.capture, "file"
    if selection.mask_file is None:
        mask_from = "suggested" if looked.facts["mask_suggested"] else "none"
    images, mask = capture.images, capture.mask
    for index, image in enumerate(images):
        picture = _small_picture(image, capture.transfer, _THUMBNAIL)
        write_image(about / f"thumbnail-{index}.jpg", picture)
    picture = _shrunk(mask_picture(images, transfer=capture.transfer), _PICTURE)
    write_image(about / "picture.jpg", picture)
    if mask_from != "none":
        size = picture.shape[1::-1]
        small = cv2.resize(255 * mask.astype(np.uint8), size)
        write_image(about / "mask.png", np.where(small > 127, 255, 0).astype(np.uint8))
    return {
        "names": list(selection.names),
        "width": mask.shape[1],
        "height": mask.shape[0],
        "transfer": capture.transfer,
        "transfer_rule": capture.transfer_rule,
        "focal": capture.focal,
        "mask": mask_from,
        "contrast": capture.mask_contrast,
        "warnings": looked.warnings,
    }


def cut(picture: Path, box: tuple[float, ...], target: Path, *, report: Report) -> None:
    """Finds the object in a box by GrabCut.

    Args:
        picture: that the box was drawn over.
        box: left, top, right, bottom in its pixels.
        target: file for the mask, of the picture's size.
        report: of progress.

    Raises:
        InputError: if nothing is found.
    """
    from unips_jax.capture.grabcut import grabcut_mask

    mask = grabcut_mask(read_image_file(picture).pixels, box=box)
    write_image(target, 255 * mask.astype(np.uint8))


def estimate(
    folder: Path,
    target: Path,
    drawn: Path,
    choices: Choices,
    max_pixels: int,
    *,
    report: Report,
) -> list[str]:
    """Estimates normals, depth, mesh and page, as `unips estimate` does.

    Args:
        folder: of the photographs.
        target: folder for the results.
        drawn: the mask, white on the object, of any size.
        choices: the visitor's.
        max_pixels: of a photograph.
        report: of progress.

    Returns:
        Warnings about the photographs.

    Raises:
        InputError: as `estimate_folder`.
    """
    from unips_jax.console import start_jax
    from unips_jax.estimation.folders import estimate_folder, load_network
    from unips_jax.estimation.options import FolderOptions

    report("starting", 0.0)
    mask: Any = "none"
    if choices.mask == "drawn":
        mask = drawn.with_name("mask-full.png")
        write_image(mask, _full_mask(drawn, select(folder).files[0], max_pixels))
    start_jax()
    options = FolderOptions(
        mask=mask,
        max_pixels=max_pixels,
        transfer=choices.transfer,  # type: ignore[arg-type]
        depth=True,
        mesh="glb" if choices.mesh else None,
        view=True,
        focal="exif" if choices.perspective else None,
    )

    def progress(done: int, total: int) -> None:
        phase = "normals" if done < total else "surface"
        report(phase, done / max(total, 1))

    record = estimate_folder(
        folder, target, load_network(), options, on_progress=progress
    )
    return list(record["warnings"])


def _full_mask(drawn: Path, photograph: Path, max_pixels: int) -> np.ndarray:
    if drawn.stat().st_size > _DRAWN_BYTES:
        raise InputError("expected a mask of at most 8 MB, got a larger one")
    values = read_image_file(drawn, max_pixels=_PICTURE**2).pixels.max(axis=-1)
    shape = read_image_file(photograph, max_pixels=max_pixels).pixels.shape
    soft = cv2.resize(values.astype(np.float32), shape[1::-1])
    if not (soft > 127).any():
        raise InputError("the mask is empty: draw over the object, or take it all")
    return np.where(soft > 127, 255, 0).astype(np.uint8)


def _small_picture(image: np.ndarray, transfer: Transfer, side: int) -> np.ndarray:
    linear = _shrunk(as_linear(_reduced(image, 4 * side), transfer), side)
    if transfer == "linear":
        linear = linear / (float(np.percentile(linear, 99.5)) or 1.0)
    return np.rint(255 * srgb_encode(np.clip(linear, 0, 1))).astype(np.uint8)


def _reduced(image: np.ndarray, side: int) -> np.ndarray:
    """Fewer pixels, unfiltered, so that little is converted."""
    step = max(1, max(image.shape[:2]) // side)
    return image[::step, ::step]


def _shrunk(picture: np.ndarray, side: int) -> np.ndarray:
    from unips_jax.pictures.maps import shrink

    return shrink(picture, side)
