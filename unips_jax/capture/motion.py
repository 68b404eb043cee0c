"""Photographs that moved: how far, and back again.

Light changes from photograph to photograph; edges keep their place, and their direction
up to its sign. So what is compared is the doubled angle of the gradient of log values,
with edges of any contrast alike (orientation correlation: Fitch et al., BMVC 2002), by
phase correlation of pairs. Places are those that most pairs agree upon (least absolute
deviations). A highlight moves with the lamp, too: a shift counts only where most parts
of the picture, each with one vote, fit better with it than without, and where light
does not explain as much (`shading`). Where the mask is known, its outline has the last
word (`outline`): it moves with the object, and light does not move it.
"""

import dataclasses

import cv2
import numpy as np

from unips_jax.capture.outline import OutlineShifts, outline_shifts
from unips_jax.capture.shading import SIDE, light_of, shift_of
from unips_jax.io.masks import mask_box

_SIDE = 384  # pixels of the longer side, where movement is sought
_ALL_PAIRS = 12  # photographs
_ANCHORS = 4  # with which each of more is compared
_WHITENING = 0.5
_SMOOTH = 4.0  # pixels: what changes more slowly is light
_FAINT = 0.005  # of the logarithm, a pixel
_MARGIN = 0.25  # of the object's box
_AROUND = 0.1  # weight of what is around the object
_BLOCKS = 8  # along the longer side
VOTES = 0.8
"""The share of a picture's parts from which on a shift is believed."""

_LEAST = 1.5  # pixels
_MODELLED = 6  # photographs, from which on light is taken into account
_AGREES = 4.0  # spreads of the parts of a picture
_SHARE = 0.005  # of the longer side
_OUTLINES = 5  # photographs, from which on outlines are compared
_FOLLOW = 0.6  # of an outline's lines
_GAIN = 0.4  # of them, more than without the shift
_STAYED = 0.8


@dataclasses.dataclass(frozen=True)
class Motion:
    """Where photographs lie."""

    # `[N, 2]`, float: pixels to the right and down that a photograph's content lies
    # from that of the reference
    offsets: np.ndarray
    # `[N]`: share of the picture's parts that agree; 1 where the offset is 0
    votes: np.ndarray
    reference: int  # the photograph that most agree with
    limit: float  # pixels from which on a photograph counts as moved

    @property
    def moved(self) -> np.ndarray:
        """Which photographs moved: `[N]`, bool."""
        far = np.hypot(*self.offsets.T) >= self.limit
        return far & (self.votes >= VOTES)


def find_motion(images: np.ndarray, mask: np.ndarray | None = None) -> Motion:
    """Finds how far photographs moved, to some tenths of a pixel of 384."""
    count, height, width = images.shape[:3]
    limit = max(_LEAST, _SHARE * max(height, width))
    rows, columns = slice(0, height), slice(0, width)
    if mask is not None and mask.any():
        longer = max(side.stop - side.start for side in mask_box(mask))
        rows, columns = mask_box(mask, round(_MARGIN * longer))
    shape = rows.stop - rows.start, columns.stop - columns.start
    scale = min(1.0, _SIDE / max(shape))
    nothing = Motion(np.zeros((count, 2)), np.ones(count), 0, limit)
    if count < 2 or min(shape) * scale < 32:
        return nothing
    fields = np.stack(
        [edge_field(grey_of(image[rows, columns], scale)) for image in images]
    )  # [N, h, w], complex
    weight = _weight(fields.shape[1:], None if mask is None else mask[rows, columns])
    places = _agreed_places(fields, weight)
    near = np.hypot(*(places[:, None] - places[None]).T) < limit * scale
    reference = int(near.sum(axis=0).argmax())
    offsets = places - places[reference]
    # Nothing is finer than what pairs agree upon, a tenth of a pixel.
    offsets[np.hypot(*offsets.T) < 0.1] = 0
    votes = _votes(fields, weight, offsets)
    motion = Motion(offsets / scale, votes, reference, limit)
    if count >= _MODELLED and motion.moved.any():
        motion = _unexplained(motion, images[:, rows, columns])
    if mask is None or count < _OUTLINES:
        return motion
    outlines = outline_shifts(images[:, rows, columns], mask[rows, columns], scale)
    return motion if outlines is None else _with_outlines(motion, outlines)


def _with_outlines(motion: Motion, outlines: OutlineShifts) -> Motion:
    """Believes the outline where it lies elsewhere, or where it stayed, clearly."""
    offsets, votes = motion.offsets.copy(), motion.votes.copy()
    votes[motion.moved & (outlines.still >= _STAYED)] = 0
    far = np.hypot(*outlines.offsets.T) >= motion.limit
    clearly = outlines.agree - outlines.still >= _GAIN
    far &= clearly & (outlines.agree >= _FOLLOW)
    if far.sum() > len(far) / 2:  # which of them moved is not known
        return dataclasses.replace(motion, votes=votes)
    missed = np.hypot(*(outlines.offsets - offsets).T) >= motion.limit
    elsewhere = far & (missed | ~motion.moved)
    offsets[elsewhere] = outlines.offsets[elsewhere]
    votes[elsewhere] = outlines.agree[elsewhere].clip(VOTES)
    return dataclasses.replace(motion, offsets=offsets, votes=votes)


def _unexplained(motion: Motion, images: np.ndarray) -> Motion:
    """Takes back what a change of light explains; images `[N, h, w, 3]`, the object."""
    scale = min(1.0, SIDE / max(images.shape[1:3]))
    stack = np.stack([light_of(image, scale) for image in images])
    aligned = stack.copy()
    for index in np.flatnonzero(motion.moved):
        matrix = np.eye(2, 3)
        matrix[:, 2] = scale * motion.offsets[index]
        aligned[index] = moved_back(stack[index], matrix, cv2.INTER_LINEAR)
    votes = motion.votes.copy()
    for index in np.flatnonzero(motion.moved):
        others = np.delete(aligned, index, axis=0)
        starts = [np.zeros(2), scale * motion.offsets[index]]
        shift = shift_of(stack[index], others, starts)
        missed = np.hypot(*(shift.offset / scale - motion.offsets[index]))
        if missed >= motion.limit or shift.score < _AGREES:
            votes[index] = 0
    return dataclasses.replace(motion, votes=votes)


def grey_of(image: np.ndarray, scale: float) -> np.ndarray:
    """The mean of the colours: `[h, w]`, float32, at `scale`, at most 1."""
    if scale < 1:
        image = cv2.resize(
            image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA
        )
    return image.astype(np.float32).mean(axis=-1)


def edge_field(grey: np.ndarray) -> np.ndarray:
    """The doubled angle of edges, `[h, w]`, complex; near 0 where there are none."""
    # A pool of light has smooth sides, which move with the lamp: they are taken out.
    top = max(float(np.percentile(grey, 99)), 1e-12)
    log = np.log(grey + 0.03 * top)
    log = cv2.GaussianBlur(log, (0, 0), 1) - cv2.GaussianBlur(log, (0, 0), _SMOOTH)
    right, down = (
        cv2.Scharr(log, cv2.CV_32F, *d, scale=1 / 32) for d in ((1, 0), (0, 1))
    )
    gradient = right + 1j * down
    power = np.abs(gradient) ** 2
    weakest = 4 * float(np.median(power)) + _FAINT**2
    return (gradient**2 / (power + weakest)).astype(np.complex64)


def _weight(shape: tuple[int, ...], mask: np.ndarray | None) -> np.ndarray:
    """What counts: the object and its outline, less towards the frame."""
    window = np.sqrt(
        np.outer(*(np.hanning(side + 2)[1:-1] for side in shape)).astype(np.float32)
    )
    if mask is None:
        return window
    size = shape[::-1]
    inside = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    inside = cv2.dilate(inside, np.ones((9, 9)))
    inside = cv2.GaussianBlur(inside, (0, 0), 6)
    return window * (_AROUND + (1 - _AROUND) * inside)


def _agreed_places(fields: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Places `[N, 2]` (x, y), whose differences are nearest to those of pairs."""
    count = len(fields)
    spectra = [np.fft.fft2((field - field.mean()) * weight) for field in fields]
    anchors = list(range(count))
    if count > _ALL_PAIRS:
        anchors = np.linspace(0, count - 1, _ANCHORS).round().astype(int).tolist()
    pairs = sorted({(max(i, j), min(i, j)) for j in anchors for i in range(count)})
    pairs = [(i, j) for i, j in pairs if i != j]
    differences, trust = zip(
        *(shift_between(spectra[i], spectra[j]) for i, j in pairs), strict=True
    )
    matrix = np.zeros((len(pairs), count))
    for row, (i, j) in enumerate(pairs):
        matrix[row, i], matrix[row, j] = 1, -1
    target, base = np.array(differences), np.array(trust)
    weights = base.copy()
    for _ in range(20):
        root = np.sqrt(weights)[:, None]
        places = np.linalg.lstsq(matrix * root, target * root, rcond=None)[0]
        missed = np.hypot(*(matrix @ places - target).T)
        weights = base / np.maximum(missed, 0.1)
    return places


def shift_between(
    first: np.ndarray, second: np.ndarray, *, furthest: float = np.inf
) -> tuple[np.ndarray, float]:
    """By how much the first lies to the right of and below the second; its trust."""
    cross = first * np.conj(second)
    cross /= np.maximum(np.abs(cross), 1e-9) ** _WHITENING
    peaks = np.fft.ifft2(cross).real
    near = [np.abs(np.fft.fftfreq(side, 1 / side)) <= furthest for side in peaks.shape]
    likely = np.where(near[0][:, None] & near[1], peaks, -np.inf)
    top = np.unravel_index(likely.argmax(), peaks.shape)
    shift = []
    for axis, side in ((1, peaks.shape[1]), (0, peaks.shape[0])):
        line = peaks[:, top[1]] if axis == 0 else peaks[top[0]]
        before, at, after = line.take(
            [top[axis] - 1, top[axis], top[axis] + 1], mode="wrap"
        )
        curve = before - 2 * at + after
        part = 0.5 * (before - after) / curve if curve < 0 else 0.0
        place = float(top[axis] + np.clip(part, -0.5, 0.5))
        shift.append(place - side if place > side / 2 else place)
    return np.array(shift), float(peaks[top] / max(peaks.std(), 1e-12))


def _votes(fields: np.ndarray, weight: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """The share of blocks in which a photograph fits the others better if moved."""
    votes = np.ones(len(fields))
    if not offsets.any():
        return votes
    back = np.stack(
        [
            field_back(field, np.concatenate([np.eye(2), offset[:, None]], axis=1))
            for field, offset in zip(fields, offsets, strict=True)
        ]
    )
    sums = fields.sum(axis=0), back.sum(axis=0)
    for index in np.flatnonzero(offsets.any(axis=1)):
        gains, spreads = [], np.full(1, 1e-12)
        for stack, total in zip((fields, back), sums, strict=True):
            own, rest = stack[index], total - stack[index]
            gains.append(_block_sums(weight * (own * np.conj(rest)).real))
            spreads = spreads + _block_sums((weight * np.abs(own) * np.abs(rest)) ** 2)
        score = (gains[1] - gains[0]) / np.sqrt(spreads)
        for_it, against = int((score > 2).sum()), int((score < -2).sum())
        enough = for_it + against >= 4
        votes[index] = for_it / (for_it + against) if enough else 0.0
    return votes


def _block_sums(values: np.ndarray) -> np.ndarray:
    side = max(1, max(values.shape) // _BLOCKS)
    rows, columns = (max(1, n // side) for n in values.shape)
    cut = values[: rows * side, : columns * side]
    return cut.reshape(rows, -1, columns, cut.shape[1] // columns).sum(axis=(1, 3))


def field_back(field: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """`moved_back` of an `edge_field`; 0 where it has no content."""
    real, imaginary = (
        moved_back(np.ascontiguousarray(part), matrix, cv2.INTER_LINEAR, zeros=True)
        for part in (field.real, field.imag)
    )
    return real + 1j * imaginary


def moved_back(
    image: np.ndarray, matrix: np.ndarray, how: int, *, zeros: bool = False
) -> np.ndarray:
    """What lies at `matrix @ (x, y, 1)` in the image, for each of its places.

    Beyond the image is its edge, or with `zeros` nothing.
    """
    border = cv2.BORDER_CONSTANT if zeros else cv2.BORDER_REPLICATE
    return cv2.warpAffine(
        image,
        matrix.astype(np.float64),
        image.shape[1::-1],
        flags=how | cv2.WARP_INVERSE_MAP,
        borderMode=border,
    )
