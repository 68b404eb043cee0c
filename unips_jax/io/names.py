"""What file names tell: which files are images, and which are no photographs."""

import re
from pathlib import Path

SUFFIXES = frozenset(
    ".png .jpg .jpeg .jfif .tif .tiff .webp .bmp .exr .hdr".split()
    + ".pgm .ppm .pnm .pbm .gif".split()
)

_MAP_WORDS = "normals?|nrm|masks?|depth|base[ _-]?colou?r|roughness|metal(?:lic|ness)?"
_MAP_NAME = re.compile(
    # Such a word of its own.
    rf"\b(?:{_MAP_WORDS}|albedo|gt)\b|^shading\b|^sheet$",
    re.IGNORECASE,
)


def is_map(name: str) -> bool:
    """Whether a file is, by its name, a map or an output and no photograph.

    Args:
        name: the file's name, in any case. `normal_gt.png`, `objMask.tif` and
            `baseColor.tif` are maps; `length_01.png` and `abnormal.jpg` are not.
    """
    words = re.sub(r"([a-z0-9])([A-Z])", r"\1 \2", Path(name).stem)
    words = re.sub(r"[\W_]+|(?<=[a-zA-Z])(?=\d)", " ", words).strip()
    return bool(_MAP_NAME.search(words))


def is_photograph(path: Path) -> bool:
    """Whether a file is, by its name, an image, not hidden and no map.

    Args:
        path: of the file.
    """
    return (
        path.suffix.lower() in SUFFIXES
        and not path.name.startswith(".")
        and not is_map(path.name)
    )
