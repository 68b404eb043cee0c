"""What every benchmark is: a list of objects, read one at a time, never written to."""

import abc
import contextlib
import dataclasses
import hashlib
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from unips_jax.baselines.method import Lights
from unips_jax.errors import InputError
from unips_jax.evaluation.benchmarks import files
from unips_jax.io.images import check_image, read_image_file, require_finite
from unips_jax.io.normal_axes import SURE, integrability


@dataclasses.dataclass(frozen=True)
class Entry:
    """One object under one lighting, known by its files."""

    name: str  # unique in the benchmark, such as `ball` or `directional/obj003`
    images: tuple[Path, ...]  # the photographs, in order
    # the other files that are read for it (mask, truth, lights)
    files: tuple[Path, ...]
    # `object`, and where they apply `lighting`, `category`, `material`, `view`
    tags: Mapping[str, str]
    # quirks of the data that were dealt with, one sentence each
    notes: tuple[str, ...] = ()


class Truth(NamedTuple):
    """What is known about an object, apart from its photographs."""

    mask: np.ndarray  # `[H, W]`, bool
    # `[H, W, 3]`, float32, as published (zero where unknown); None where the truth is
    # withheld
    normals: np.ndarray | None
    lights: Lights | None = None  # known distant lights of all images
    # in pixels; infinite for an orthographic camera, None where unknown
    focal: float | None = None
    notes: tuple[str, ...] = ()


class Item(NamedTuple):
    """An object, read; `name`, `tags` and `notes` as in `Entry`."""

    name: str
    images: np.ndarray  # `[N, H, W, 3]`, uint8, uint16 or float32, taken as linear
    mask: np.ndarray  # `[H, W]`, bool
    # `[H, W, 3]`, float32; zero outside the mask and where the published truth has no
    # direction; None where the truth is withheld
    normals: np.ndarray | None
    lights: Lights | None  # known distant lights
    # in pixels; infinite for an orthographic camera, None where unknown
    focal: float | None
    tags: Mapping[str, str]
    notes: tuple[str, ...]


class Benchmark(abc.ABC):
    """A benchmark as published, on disk.

    Building one checks the layout: every file that will be read must be there. `check`
    reads an object's files through; `benchmark[i]` gives the object. What is missing,
    damaged or does not agree is an `InputError`.

    Attributes:
        name: as on the command line.
        default_protocol: the protocol its published scores were measured with.
        channels: numbers of channels its photographs may have.
        crop_focal_ratio: focal length over the side of the square crop, where the
            camera is not known but published scores assumed one.
        root: the folder given.
        entries: its objects.
        left_out: folders that hold photographs, but nothing to compare with.
    """

    name: ClassVar[str]
    default_protocol: ClassVar[str] = "native"
    channels: ClassVar[tuple[int, ...]] = (3,)
    crop_focal_ratio: ClassVar[float | None] = None
    left_out: tuple[Path, ...] = ()

    def __init__(self, root: str | os.PathLike[str], *, objects: Sequence[str] = ()):
        """Finds the files; keeps only `objects` (entries' or objects' names) if any."""
        self.root = files.require_folder(Path(root), f"the benchmark {self.name}")
        found = list(self.find(tuple(objects)))
        if not found and not objects:
            raise InputError(f"{self.root}: holds no object of the benchmark")
        known = {name for entry in found for name in (entry.name, entry.tags["object"])}
        twice = [name for name, n in Counter(e.name for e in found).items() if n > 1]
        if twice:
            raise InputError(
                f"{self.root}: expected objects of different names, got two named "
                f"{twice[0]!r}; rename one"
            )
        unknown = [name for name in objects if name not in known]
        if unknown:
            there = _some(sorted(known | self._names()))
            raise InputError(
                f"no object {unknown[0]!r} in {self.root}"
                + (f"; it has {there}" if there else "")
            )
        self.entries = tuple(
            entry
            for entry in found
            if not objects or {entry.name, entry.tags["object"]} & set(objects)
        )
        for entry in self.entries:
            for path in (*entry.images, *entry.files):
                files.require_file(path, f"a file of {entry.name}")

    @abc.abstractmethod
    def find(self, objects: tuple[str, ...]) -> Iterator[Entry]:
        """Yields the entries; passes over objects other than those wanted, if any."""

    def _names(self) -> set[str]:
        """What objects may be asked for by, up to the first that is not whole."""
        names: set[str] = set()
        with contextlib.suppress(InputError):
            for entry in self.find(()):
                names |= {entry.name, entry.tags["object"]}
        return names

    @abc.abstractmethod
    def truth(self, entry: Entry) -> Truth:
        """Reads everything but the photographs."""

    def __len__(self) -> int:
        return len(self.entries)

    def __getitem__(self, index: int) -> Item:
        entry = self.entries[index]
        truth = self._checked_truth(entry)
        stack, focal, notes = self.photographs(entry, truth.mask)
        return Item(
            entry.name,
            stack,
            truth.mask,
            truth.normals,
            truth.lights,
            focal if truth.focal is None else truth.focal,
            entry.tags,
            entry.notes + truth.notes + notes,
        )

    def photographs(
        self, entry: Entry, mask: np.ndarray
    ) -> tuple[np.ndarray, float | None, tuple[str, ...]]:
        """`Item`'s images, the focal length where these hold it, and notes."""
        stack: np.ndarray | None = None
        for i, path in enumerate(entry.images):
            file = read_image_file(path)
            require_finite(path, file.pixels)
            self._check_image(path, file.channels, file.pixels.shape[:2], mask.shape)
            image = np.broadcast_to(file.pixels, (*mask.shape, 3))
            if stack is None:
                stack = np.empty((len(entry.images), *mask.shape, 3), image.dtype)
            elif image.dtype != stack.dtype:
                raise _unlike(path, image.dtype, entry, stack.dtype)
            stack[i] = image
        assert stack is not None  # `find` never yields an entry without images
        images, notes = at_most_one(stack, mask)
        return images, None, notes

    def check(self, index: int) -> str:
        """Reads an object's files through without keeping its photographs.

        Returns a hash of the names (relative to the root) and contents of all its
        files, and of what the reader made of them.
        """
        entry = self.entries[index]
        truth = self._checked_truth(entry)
        digest = hashlib.blake2b(digest_size=16)
        for path, data in self.checked_photographs(entry, truth.mask):
            self._digest(digest, path, data)
        for path in entry.files:
            self._digest(digest, path, files.read_bytes(path))
        digest.update(repr(sorted(entry.tags.items())).encode())
        return digest.hexdigest()

    def checked_photographs(
        self, entry: Entry, mask: np.ndarray
    ) -> Iterator[tuple[Path, bytes]]:
        """The photographs' files and contents, once they are known to be sound."""
        first: np.dtype | None = None
        for path in entry.images:
            data = files.read_bytes(path)
            height, width, channels, dtype = check_image(data, path)
            self._check_image(path, channels, (height, width), mask.shape)
            first = first or dtype
            if dtype != first:
                raise _unlike(path, dtype, entry, first)
            yield path, data

    def _digest(self, digest: "hashlib.blake2b", path: Path, data: bytes) -> None:
        name = Path(os.path.relpath(path, self.root)).as_posix()
        head = f"{name}\0{len(data)}\0"
        digest.update(head.encode(errors="surrogateescape"))
        digest.update(data)

    def _check_image(
        self, path: Path, channels: int, size: tuple[int, ...], expected: Sequence[int]
    ) -> None:
        if channels not in self.channels:
            allowed = " or ".join(map(str, self.channels))
            raise InputError(f"{path}: expected {allowed} channels, got {channels}")
        if tuple(size) != tuple(expected):
            raise InputError(
                f"{path}: {size[1]} x {size[0]} pixels, but the mask has "
                f"{expected[1]} x {expected[0]}"
            )

    def _checked_truth(self, entry: Entry) -> Truth:
        truth = self.truth(entry)
        where = f"{self.root}, {entry.name}"
        if not truth.mask.any():
            raise InputError(
                f"{where}: expected a mask of the object, got an empty one; mend it"
            )
        count = len(entry.images)
        if truth.lights is not None and len(truth.lights.directions) != count:
            raise InputError(
                f"{where}: {count} images but {len(truth.lights.directions)} lights"
            )
        if truth.normals is None:
            return truth
        if truth.normals.shape != (*truth.mask.shape, 3):
            raise InputError(
                f"{where}: the true normals have shape {truth.normals.shape}, the mask "
                f"{truth.mask.shape}"
            )
        # A zero vector stored in integers decodes to a length of up to 0.007.
        known = truth.mask & (np.linalg.norm(truth.normals, axis=-1) > 0.1)
        normals = np.where(known[..., None], truth.normals, 0).astype(np.float32)
        inside = normals[truth.mask]
        notes = list(truth.notes)
        zero = int((truth.mask & ~known).sum())
        if zero == len(inside):
            raise InputError(f"{where}: all true normals are zero")
        length = float(np.median(np.linalg.norm(normals[known], axis=-1)))
        if not 0.9 <= length <= 1.1:
            raise InputError(
                f"{where}: expected true normals of length 1, got {length:.2f} (the "
                "median); floats hold n, integers (n + 1) / 2"
            )
        if zero:
            notes.append(f"{zero} true normals of zero length count as 90 degrees")
        if integrability(normals) < -SURE:
            notes.append(
                "slopes of the true normals do not fit together as a surface's do: y "
                "may point down, or x to the left, where x right, y up is expected"
            )
        if inside[:, 2].mean() < 0:
            notes.append(
                "on average the true normals point away from the viewer: the file may "
                "follow another convention than x right, y up, z to the viewer"
            )
        return truth._replace(normals=normals, notes=tuple(notes))


def at_most_one(
    images: np.ndarray, mask: np.ndarray
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Photographs `[N, H, W, 3]`, floats above 1 divided by their largest; a note."""
    if images.dtype.kind != "f":
        return images, ()
    # Methods that clip take a value of 1 for the brightest.
    top = float(images[:, mask].max())
    if top <= 1:
        return images, ()
    note = f"photographs divided by {top:g}, their largest value"
    return images / np.float32(top), (note,)


def distant_lights(
    directions: np.ndarray, intensities: np.ndarray | None, where: Path
) -> Lights:
    """Lights from tables `[N, 3]`, directions to the light brought to unit length.

    Intensities are 1 where None; `InputError` where numbers can't be lights.
    """
    length = np.linalg.norm(directions, axis=1, keepdims=True)
    if (length == 0).any():
        raise InputError(
            f"{where}: light {int(np.argmin(length)) + 1} has no direction"
        )
    if intensities is None:
        intensities = np.ones_like(directions)
    if len(intensities) != len(directions):
        raise InputError(
            f"{where}: {len(directions)} light directions but {len(intensities)} "
            "intensities"
        )
    if (intensities <= 0).any():
        row = int(np.argwhere(intensities <= 0)[0, 0])
        raise InputError(
            f"{where}: light {row + 1} has an intensity that is not positive"
        )
    return Lights(
        (directions / length).astype(np.float32), intensities.astype(np.float32)
    )


def _unlike(
    path: Path, dtype: np.dtype, entry: Entry, expected: np.dtype
) -> InputError:
    return InputError(
        f"{path}: expected {expected} pixels, as in {entry.images[0].name}, got "
        f"{dtype}; export all photographs in the same way"
    )


def _some(names: Sequence[str], limit: int = 12) -> str:
    more = f" and {len(names) - limit} more" if len(names) > limit else ""
    return ", ".join(names[:limit]) + more
