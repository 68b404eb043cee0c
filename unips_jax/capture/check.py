"""All that is looked for in photographs before an estimate."""

import statistics
from collections import Counter
from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from unips_jax.capture.advice import look_at_values
from unips_jax.capture.findings import Finding, by_file, some
from unips_jax.capture.light import look_at_encoding, look_at_light
from unips_jax.capture.motion import Motion, find_motion
from unips_jax.capture.shading import sums_of_parts
from unips_jax.io.masks import mask_box
from unips_jax.io.photographs import Capture

_UNTAGGED = "8-bit values"  # the rule of `io.color` where there is no tag
_FOCUS_SIDE = 1024
_BLURRED = 0.6  # of the median of fine detail over coarse
_BLURRED_PARTS = 0.85  # the same, in three quarters of the picture's parts
_FEWEST_PARTS = 6
_PART = 8  # least side
_WHOLE = 0.95  # of the image
_EXPOSURES = 1.26  # a third of a stop


def check_capture(
    capture: Capture,
    names: Sequence[str],
    *,
    motion: Motion | None = None,
    taken: np.ndarray | None = None,
) -> list[Finding]:
    """Lists what is wrong with photographs, whose `motion` may be known already.

    `taken` are the images as the camera had them, where a dark frame was subtracted.
    """
    images, mask = capture.images, capture.mask
    if motion is None:
        motion = find_motion(images, None if mask.all() else mask)
    found = [
        *_look_at_object(capture),
        *look_at_values(images, mask, names, taken=taken),
        *_look_at_motion(motion, names),
        *_look_at_focus(images, mask, names),
        *_look_at_cameras(capture, names),
    ]
    if not any(f.kind in ("same light", "few photographs") for f in found):
        found += look_at_light(images, mask, capture.transfer)
    if capture.transfer_rule == _UNTAGGED:
        found += look_at_encoding(images if taken is None else taken, mask)
    return found


def _look_at_object(capture: Capture) -> list[Finding]:
    """Whether an object was looked for in vain, and all there is would be estimated."""
    if capture.mask_contrast is None or capture.mask_rule:
        return []
    what, risk = "the whole image", "a flat desk or wall would come out curved"
    left_out = any(note.endswith(": left out") for note in capture.notes)
    if left_out and capture.mask.mean() < _WHOLE:
        black = "black" if capture.opaque is None else "black or transparent"
        what, risk = f"all that is not {black}", "that may be highlights alone"
    return [
        Finding(
            "no object",
            f"no object found: {what} is taken as one surface, and {risk}; give "
            f"--mask FILE, or --mask none if {what} is meant",
        )
    ]


def _look_at_motion(motion: Motion, names: Sequence[str]) -> list[Finding]:
    distances = {
        names[i]: float(np.hypot(*motion.offsets[i]))
        for i in np.flatnonzero(motion.moved).tolist()
    }
    return by_file(
        "moved",
        distances,
        "{:.0f}",
        "moved: {} pixels from where the others lie; --register brings them back, or "
        "leave them out; next time fix camera and object",
    )


def _look_at_focus(
    images: np.ndarray, mask: np.ndarray, names: Sequence[str]
) -> list[Finding]:
    """Photographs with far less fine detail, for their coarse, than the others."""
    if len(images) < 3:
        return []
    rows, columns = (_middle(side, _FOCUS_SIDE) for side in mask_box(mask))
    inside = cv2.erode(mask[rows, columns].astype(np.uint8), np.ones((9, 9))) > 0
    if inside.sum() < 400:
        return []
    bands = [_bands(image[rows, columns], inside) for image in images]  # [N, 2, h, w]
    detail = np.array([fine.sum() / max(coarse.sum(), 1e-9) for fine, coarse in bands])
    detail /= np.median(detail) or 1.0
    soft = {
        name: float(value)
        for name, value, part in zip(
            names, detail, _soft_parts(bands, inside), strict=True
        )
        if value < _BLURRED and part < _BLURRED_PARTS
    }
    return by_file(
        "out of focus",
        soft,
        "{:.0%}",
        "out of focus or shaken: {} of the others' fine detail; leave them out or take "
        "them again, focus fixed",
    )


def _middle(side: slice, most: int) -> slice:
    spare = max(side.stop - side.start - most, 0) // 2
    return slice(side.start + spare, side.stop - spare)


def _bands(image: np.ndarray, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How much fine and coarse detail there is: `[h, w]` each, 0 outside."""
    grey = image.astype(np.float32).mean(axis=-1)
    log = np.log(grey + max(0.05 * float(np.percentile(grey[inside], 99)), 1e-12))
    a, b, c, d = (cv2.GaussianBlur(log, (0, 0), s) for s in (0.7, 1.4, 2.8, 5.6))
    return np.abs(a - b) * inside, np.abs(c - d) * inside


def _soft_parts(
    bands: Sequence[tuple[np.ndarray, np.ndarray]], inside: np.ndarray
) -> np.ndarray:
    """Below what share of the others' fine detail three quarters of the parts are."""
    fine, coarse = (
        np.array([sums_of_parts(pair[band], _PART) for pair in bands])
        for band in (0, 1)
    )
    known = sums_of_parts(inside.astype(np.float32), _PART) > _PART**2 / 2
    if np.count_nonzero(known) < _FEWEST_PARTS:
        return np.ones(len(bands))
    ratios = np.log((fine[:, known] + 1e-9) / (coarse[:, known] + 1e-6))
    others = [np.delete(ratios, i, axis=0) for i in range(len(ratios))]
    usual = np.median(others, axis=1)
    return np.exp(np.quantile(ratios - usual, 0.75, axis=1))


def _look_at_cameras(capture: Capture, names: Sequence[str]) -> Iterator[Finding]:
    cameras = Counter(camera for camera in capture.cameras if camera)
    if len(cameras) > 1:
        usual = cameras.most_common(1)[0][0]
        others = tuple(
            name
            for name, camera in zip(names, capture.cameras, strict=True)
            if camera and camera != usual
        )
        yield Finding(
            "mixed cameras",
            f"mixed cameras: {' and '.join(sorted(cameras))} ({some(others)}): "
            "photographs of one object must be taken by one camera",
            others,
        )
    known = [exposure for exposure in capture.exposures if exposure]
    if known and max(known) > _EXPOSURES * min(known):
        typical = statistics.median(known)
        ratios = {
            name: exposure / typical
            for name, exposure in zip(names, capture.exposures, strict=True)
            if exposure and not 1 / _EXPOSURES < exposure / typical < _EXPOSURES
        }
        yield from by_file(
            "exposure changes",
            ratios,
            "x{:.2g}",
            "exposure changes: {} of the usual, by EXIF data; set time, aperture and "
            "ISO by hand, or dark photographs are noisy and bright ones saturated",
        )
