"""EXR, by OpenEXR: the picture among a file's layers.

By the format's convention channels R, G, B (or Y) without a layer's name are the
picture. Failing these it is the only layer that has them and is no map by its name.
"""

import contextlib
import io
import os
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import OpenEXR

from unips_jax.io.formats.encoded import Encoded, NotRead
from unips_jax.io.selection import is_map

MAGIC = b"\x76\x2f\x31\x01"

_SHOWN = 20  # channels
_HEADERS = {"separate_channels": True, "header_only": True}


def open_exr(data: bytes, *, vectors: bool = False) -> Encoded:
    """Reads an EXR's headers; `vectors`: X, Y, Z and layers named as maps too."""
    headers = [part.header for part in OpenEXR.File(io.BytesIO(data), **_HEADERS).parts]
    index, names = _picture(headers, vectors)
    header = headers[index]
    channels = {channel.name: channel for channel in header["channels"]}
    if header.get("type") in (OpenEXR.deepscanline, OpenEXR.deeptile):
        raise NotRead("a deep EXR")
    for name in names:
        if (channels[name].xSampling, channels[name].ySampling) != (1, 1):
            raise NotRead(f"an EXR whose channel {name} is subsampled")
    windows = header["dataWindow"], header["displayWindow"]
    width, height = (int(n) for n in _size(windows[1]))

    def decode() -> np.ndarray:
        with quiet():
            whole = OpenEXR.File(io.BytesIO(data), separate_channels=True)
        planes = [whole.parts[index].channels[name].pixels for name in names]
        kinds = {plane.dtype for plane in planes}
        if not kinds <= {np.dtype(np.float16), np.dtype(np.float32)}:
            raise NotRead("an EXR of integers")
        return displayed(np.stack(planes, axis=-1).astype(np.float32), *windows)

    return Encoded(
        "EXR",
        height,
        width,
        len(names),
        len(names) in (2, 4),
        np.dtype(np.float32),
        decode,
        allocated=max(map(_allocated, headers)),  # all parts are decoded
        primaries=tuple(header.get("chromaticities", ())),
    )


def displayed(
    image: np.ndarray,
    data: tuple[np.ndarray, np.ndarray],
    display: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """The display window of an EXR image `[h, w, C]`; zeros where it has no data."""
    (left, top), (right, bottom) = data[0] - display[0], data[1] - display[0] + 1
    width, height = display[1] - display[0] + 1
    if (left, top, right, bottom) == (0, 0, width, height):
        return image
    result = np.zeros((height, width, image.shape[-1]), image.dtype)
    rows = slice(max(top, 0), min(bottom, height))
    columns = slice(max(left, 0), min(right, width))
    if rows.start < rows.stop and columns.start < columns.stop:
        result[rows, columns] = image[
            rows.start - top : rows.stop - top,
            columns.start - left : columns.stop - left,
        ]
    return result


def _allocated(header: dict[str, Any]) -> int:
    """Pixels of the data window, or of a tile that is larger."""
    width, height = (int(n) for n in _size(header["dataWindow"]))
    tiles = header.get("tiles")
    tile = tiles.xSize * tiles.ySize if tiles is not None else 0
    return max(width * height, tile)


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keeps off the terminal what libraries print before they raise."""
    # Output belongs to the whole process, so only its main thread may take it.
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    sys.stderr.flush()
    saved = os.dup(2)
    with tempfile.TemporaryFile() as sink, contextlib.redirect_stdout(io.StringIO()):
        os.dup2(sink.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(saved, 2)
            os.close(saved)


def _size(window: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Width and height of a window."""
    return np.asarray(window[1], np.int64) - np.asarray(window[0], np.int64) + 1


def _picture(headers: Sequence[dict[str, Any]], vectors: bool) -> tuple[int, list[str]]:
    """The part and the channels of the picture, alpha last."""
    found: dict[str, tuple[int, list[str]]] = {}
    everything: list[str] = []
    for index, header in enumerate(headers):
        names = {channel.name for channel in header["channels"]}
        if "RY" in names:
            raise NotRead("an EXR of luminance and chroma")
        title = f"{header.get('name', index)}." if len(headers) > 1 else ""
        everything += [title + name for name in names]
        for name in sorted(names):
            layer = name[: name.rfind(".") + 1]
            for colours in ("RGB", "rgb", "XYZ" if vectors else "", "Y"):
                if colours == "Y" and names & {layer + "X", layer + "Z"}:
                    colours = ""  # a component of vectors
                wanted = [layer + c for c in colours]
                if colours and title + layer not in found and names.issuperset(wanted):
                    alpha = [layer + "A"] if layer + "A" in names else []
                    found[title + layer] = index, wanted + alpha
    if "" in found:
        return found[""]
    pictures = {
        layer: place
        for layer, place in found.items()
        if vectors or not any(is_map(word) for word in layer.split("."))
    }
    if len(pictures) == 1:
        return next(iter(pictures.values()))
    shown = ", ".join(sorted(everything)[:_SHOWN]) or "none"
    more = f" and {len(everything) - _SHOWN} more" if len(everything) > _SHOWN else ""
    raise NotRead(
        f"an EXR with the channels {shown}{more}, not R, G, B or Y in one layer that "
        "is no map"
    )
