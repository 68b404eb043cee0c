"""Photographs of several places of the camera, sorted by when they were taken."""

from collections.abc import Sequence
from pathlib import Path

from unips_jax.errors import InputError
from unips_jax.io.images import MAX_PIXELS, image_header, read_bytes
from unips_jax.io.naming import natural_key


def views_by_time(
    files: Sequence[Path], pause: float, *, max_pixels: int = MAX_PIXELS
) -> list[list[Path]]:
    """Sorts photographs by time; a pause of more than `pause` seconds begins a view."""
    times = {}
    for file in files:
        data = read_bytes(file, max_pixels=max_pixels)
        times[file] = image_header(data, file, max_pixels=max_pixels).taken
    unknown = [file for file, time in times.items() if not time]
    if unknown:
        raise InputError(
            f"{unknown[0]}: expected EXIF data that say when it was taken, got none in "
            f"{len(unknown)} of {len(times)} photographs; put those of each view into "
            "a folder of their own"
        )
    views: list[list[Path]] = []
    last = -float("inf")
    for file in sorted(files, key=lambda file: (times[file], natural_key(file.name))):
        if times[file] - last > pause:
            views.append([])
        views[-1].append(file)
        last = times[file]
    return views
