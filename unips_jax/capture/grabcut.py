"""A mask from a box or a few strokes: GrabCut (Rother et al., SIGGRAPH 2004)."""

from collections.abc import Sequence

import cv2
import numpy as np

from unips_jax.errors import InputError

_SIDE = 640  # pixels of the longer side, where the mask is sought
_ROUNDS = 5


def grabcut_mask(
    picture: np.ndarray,
    *,
    box: Sequence[float] | None = None,
    inside: np.ndarray | None = None,
    outside: np.ndarray | None = None,
) -> np.ndarray:
    """Finds the object from a box around it, strokes on it, or both: `[H, W]`, bool.

    Of a picture `[H, W, 3]`, uint8, such as `masks.mask_picture` gives. The box is
    left, top, right and bottom in pixels, right and bottom outside: nothing beyond it
    is the object. `inside`, `outside`: strokes on the object and the background. The
    same arguments give the same mask. `InputError` if there is neither a box nor a
    stroke on the object, if these leave nothing to decide or find, or sizes differ.
    """
    shape = picture.shape[:2]
    _check(picture, box, inside, outside)
    scale = min(1.0, _SIDE / max(shape))
    size = max(1, round(shape[1] * scale)), max(1, round(shape[0] * scale))
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    drawn = [_reduced(painted, size) for painted in (inside, outside)]
    trimap = _trimap(small, drawn, None if box is None else [scale * v for v in box])
    mask = _cut(small, trimap)
    soft = cv2.resize(
        mask.astype(np.float32), shape[::-1], interpolation=cv2.INTER_LINEAR
    )
    mask = soft > 0.5
    if box is not None:
        left, top, right, bottom = (max(round(value), 0) for value in box)
        within = np.zeros_like(mask)
        within[top:bottom, left:right] = True
        mask &= within
    if inside is not None:
        mask |= inside
    if outside is not None:
        mask &= ~outside
    return mask


def _reduced(drawn: np.ndarray | None, size: tuple[int, int]) -> np.ndarray:
    if drawn is None:
        return np.zeros(size[::-1], bool)
    return cv2.resize(drawn.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0


def _trimap(
    picture: np.ndarray, drawn: Sequence[np.ndarray], box: Sequence[float] | None
) -> np.ndarray:
    """What is known and what is likely, before GrabCut."""
    inside, outside = drawn
    shape = picture.shape[:2]
    if box is not None:
        left, top, right, bottom = (max(round(value), 0) for value in box)
        likely = np.zeros(shape, bool)
        likely[top:bottom, left:right] = True
        outside = outside | ~likely
    else:
        beyond = outside
        if not beyond.any():  # the margin, most likely
            beyond = np.ones(shape, bool)
            beyond[2:-2, 2:-2] = False
        likely = _nearest(picture, inside) < _nearest(picture, beyond & ~inside)
    trimap = np.where(likely, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    trimap[outside] = cv2.GC_BGD
    trimap[inside] = cv2.GC_FGD
    return trimap


def _nearest(picture: np.ndarray, where: np.ndarray) -> np.ndarray:
    """How far each colour is from the nearest of those there: `[H, W]`."""
    colours = picture[where].astype(np.float32)
    colours = colours[:: max(1, len(colours) // 64)]
    values = picture.astype(np.float32)
    nearest = np.full(where.shape, np.inf, np.float32)
    for colour in colours:
        np.minimum(nearest, ((values - colour) ** 2).sum(axis=-1), out=nearest)
    return nearest


def _cut(picture: np.ndarray, trimap: np.ndarray) -> np.ndarray:
    known = np.isin(trimap, (cv2.GC_FGD, cv2.GC_PR_FGD))
    if not known.any() or known.all():
        what = "all" if known.all() else "none"
        raise InputError(
            f"box and strokes: expected object and background, got {what} of the "
            "picture as the object; draw the box closer, or strokes on both"
        )
    cv2.setRNGSeed(0)  # its first clusters are drawn
    models = np.zeros((1, 65)), np.zeros((1, 65))
    trimap = trimap.copy()
    cv2.grabCut(
        np.ascontiguousarray(picture[..., ::-1]),
        trimap,
        (0, 0, 1, 1),  # unused with a mask
        *models,
        _ROUNDS,
        cv2.GC_INIT_WITH_MASK,
    )
    mask = np.isin(trimap, (cv2.GC_FGD, cv2.GC_PR_FGD))
    if not mask.any():
        raise InputError(
            "box and strokes: expected an object that differs from its background, "
            "found none; draw strokes on the object, or more of them"
        )
    return mask


def _check(
    picture: np.ndarray,
    box: Sequence[float] | None,
    inside: np.ndarray | None,
    outside: np.ndarray | None,
) -> None:
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
        raise InputError(
            f"picture: expected [H, W, 3] of uint8, got {list(picture.shape)} of "
            f"{picture.dtype}; make it with mask_picture"
        )
    for name, drawn in (("inside", inside), ("outside", outside)):
        if drawn is not None and drawn.shape != picture.shape[:2]:
            raise InputError(
                f"{name}: expected the picture's size {list(picture.shape[:2])}, got "
                f"{list(drawn.shape)}; draw over that picture"
            )
    if box is None and (inside is None or not inside.any()):
        raise InputError(
            "expected a box, or a stroke on the object, got neither; draw one"
        )
    if box is not None and not (box[0] < box[2] and box[1] < box[3]):
        raise InputError(
            f"box: expected left < right and top < bottom, got {list(box)}; draw it "
            "from corner to corner"
        )


def strokes(
    shape: tuple[int, int],
    lines: Sequence[Sequence[tuple[float, float]]],
    *,
    width: int = 5,
) -> np.ndarray:
    """Paints strokes, points (x, y) in pixels, on a picture: `[H, W]`, bool."""
    painted = np.zeros(shape, np.uint8)
    for line in lines:
        points = np.rint(np.asarray(line, np.float64)).astype(np.int32).reshape(-1, 2)
        cv2.polylines(painted, [points], False, 1, width)
        if len(points) == 1:
            cv2.circle(painted, points[0].tolist(), max(width // 2, 1), 1, -1)
    return painted > 0
