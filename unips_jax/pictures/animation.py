"""Moving pictures: MP4, GIF and WebP."""

import errno
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import numpy as np

from unips_jax.io.door import new_file, new_path

AnimationFormat = Literal["mp4", "gif", "webp"]
# VP9 plays in browsers; not every build of OpenCV has it, but each has the other.
_CODECS = ("vp09", "mp4v")


def write_animation(path: Path, frames: Iterable[np.ndarray], *, fps: float) -> None:
    """Writes frames `[H, W, 3]`, uint8, as they come: `.mp4`, `.gif` or `.webp`.

    GIF and WebP repeat for ever. MP4s have even sides: a last black row or column is
    added where needed.
    """
    if path.suffix.lower() == ".mp4":
        with new_path(path) as part:
            _write_mp4(part, frames, fps)
        return
    from PIL import Image

    pictures = (Image.fromarray(frame) for frame in frames)
    first = next(pictures)
    with new_file(path) as file:
        first.save(
            file,
            format=path.suffix[1:],
            save_all=True,
            append_images=pictures,
            duration=round(1000 / fps),
            loop=0,
            quality=85,  # of WebP
        )


def _write_mp4(path: Path, frames: Iterable[np.ndarray], fps: float) -> None:
    import cv2

    try:
        str(path).encode()
    except UnicodeEncodeError:  # which ends OpenCV's process
        problem = "OpenCV writes an MP4 into a path in UTF-8 only; take gif or webp"
        raise OSError(errno.EILSEQ, problem) from None
    writer, count = None, 0
    try:
        for frame in frames:
            count += 1
            height, width, _ = frame.shape
            even = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)))
            if writer is None:
                writer = _writer(path, fps, even.shape[1::-1])
            writer.write(cv2.cvtColor(even, cv2.COLOR_RGB2BGR))
    finally:
        if writer is not None:
            writer.release()
    reader = cv2.VideoCapture(str(path))
    written = round(reader.get(cv2.CAP_PROP_FRAME_COUNT))
    reader.release()
    if written != count:  # OpenCV writes on without a word where the disk is full
        raise OSError(errno.EIO, f"{written} of {count} frames could be written")


def _writer(path: Path, fps: float, size: tuple[int, ...]) -> Any:
    import cv2

    for codec in _CODECS:
        writer = cv2.VideoWriter(
            str(path), cv2.VideoWriter.fourcc(*codec), fps, tuple(size)
        )
        if writer.isOpened():
            return writer
    raise OSError("OpenCV has no encoder for MP4 here; take gif or webp")
