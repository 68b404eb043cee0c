"""A folder of photographs looked at, whatever is wrong with it."""

import dataclasses
from collections import Counter
from collections.abc import Callable, Hashable
from typing import Any

from unips_jax.capture.check import check_capture
from unips_jax.capture.findings import Finding, some
from unips_jax.capture.prepare import with_suggested_mask
from unips_jax.errors import InputError
from unips_jax.io.color import Transfer
from unips_jax.io.formats import Encoded
from unips_jax.io.images import MAX_PIXELS, image_header, read_bytes
from unips_jax.io.photographs import Capture, read_capture
from unips_jax.io.selection import Selection


@dataclasses.dataclass(frozen=True)
class Report:
    """What was found."""

    selection: Selection  # the photographs
    capture: Capture | None  # those that fit together, read; None where they cannot be
    findings: tuple[Finding, ...]  # what is wrong; empty if nothing is

    def renamed(self, text_of: Callable[[str], str]) -> "Report":
        """The same, with each finding's text as `text_of` has it."""
        found = (dataclasses.replace(f, text=text_of(f.text)) for f in self.findings)
        return dataclasses.replace(self, findings=tuple(found))

    def record(self) -> dict[str, Any]:
        """JSON values."""
        record: dict[str, Any] = {
            "folder": self.selection.title,
            "photographs": [*self.selection.names],
            "left_out": self.selection.left_out,
            "findings": [finding.record() for finding in self.findings],
        }
        if self.capture is None:
            return record
        height, width = self.capture.mask.shape
        mask_file = self.selection.mask_file
        return record | {
            "width": width,
            "height": height,
            "dtype": str(self.capture.images.dtype),
            "notes": [*self.capture.notes],
            "transfer": self.capture.transfer,
            "transfer_rule": self.capture.transfer_rule,
            "mask": None if mask_file is None else str(mask_file),
            "mask_pixels": int(self.capture.mask.sum()),
            "mask_contrast": self.capture.mask_contrast,
            "mask_rule": self.capture.mask_rule,
            "mask_suggested": bool(self.capture.mask_rule),
        }


def check_photographs(
    selection: Selection,
    *,
    transfer: Transfer | None = None,
    look_for_mask: bool = True,
    max_pixels: int = MAX_PIXELS,
) -> Report:
    """Looks at photographs, and at those that fit together more closely."""
    headers, found = {}, []
    for path in selection.files:
        try:
            data = read_bytes(path, max_pixels=max_pixels)
            headers[path.name] = image_header(data, path, max_pixels=max_pixels)
        except InputError as error:
            found.append(Finding("unreadable", str(error), (path.name,)))
    fitting, odd = _alike(headers, transfer)
    found += odd
    capture, names, unusable = _read(selection, fitting, transfer, max_pixels)
    found += unusable
    if capture is not None:
        if look_for_mask and selection.mask_file is None:
            capture = with_suggested_mask(capture)
        found += check_capture(capture, names)
    return Report(selection, capture, tuple(found))


def _read(
    selection: Selection,
    fitting: set[str],
    transfer: Transfer | None,
    max_pixels: int,
) -> tuple[Capture | None, tuple[str, ...], list[Finding]]:
    """The photographs that can be read together, their names, and why others cannot."""
    files = [f for f in selection.files if f.name in fitting]
    found: list[Finding] = []
    while files:
        taken = dataclasses.replace(selection, files=tuple(files))
        try:
            capture = read_capture(taken, transfer=transfer, max_pixels=max_pixels)
            return capture, taken.names, found
        except InputError as error:
            bad = [f for f in files if str(error).startswith(f"{f}: ")][:1]
            names = tuple(f.name for f in bad)
            found.append(Finding("unusable", str(error), names))
            files = [f for f in files if f not in bad] if bad else []
    return None, (), found


_KINDS: dict[str, tuple[Callable[[Encoded], Hashable], str]] = {
    "mixed sizes": (
        lambda h: f"{h.width} x {h.height} pixels",
        "re-export them in one size, uncropped",
    ),
    "mixed types": (
        lambda h: f"{h.dtype} pixels",
        "export all photographs in the same way",
    ),
}


def _alike(
    headers: dict[str, Encoded], transfer: Transfer | None
) -> tuple[set[str], list[Finding]]:
    """The names of most files that fit together, and what is wrong with the others."""
    names, found = set(headers), []
    kinds = dict(_KINDS)
    if transfer is None:
        kinds["mixed encodings"] = (
            lambda h: f"{h.encoding.transfer} values",
            "export all photographs in the same way, or give --transfer",
        )
    for kind, (of, fix) in kinds.items():
        counts = Counter(of(headers[name]) for name in headers if name in names)
        if len(counts) < 2:
            continue
        usual = counts.most_common(1)[0][0]
        others = [n for n in headers if n in names and of(headers[n]) != usual]
        shown = [f"{name} has {of(headers[name])}" for name in others]
        found.append(
            Finding(
                kind, f"{kind}: {some(shown)}, the others {usual}; {fix}", tuple(others)
            )
        )
        names -= set(others)
    return names, found
