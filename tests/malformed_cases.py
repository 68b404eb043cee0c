"""Folders of malformed files and arguments of commands, for `test_fuzz.py`.

Apart from it because Hypothesis takes seconds to import, which not every run needs.
"""

import tempfile
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from unips_jax import weights

CONFIG = "from unips_jax.training.config import *\ndef get_config(): return Config()\n"
_CHECKS = [
    HealthCheck.too_slow,
    HealthCheck.data_too_large,
    HealthCheck.filter_too_much,
]


def run_cases(check, **options):
    """Calls `check` with cases: the files of a folder, and a command's arguments."""
    chosen = settings(
        deadline=None, database=None, suppress_health_check=_CHECKS, **options
    )
    chosen(given(cases())(check))()


def _examples():
    """Contents of small files of every kind, by suffix."""
    picture = np.arange(12 * 10 * 3, dtype=np.uint8).reshape(12, 10, 3)
    found = {}
    for suffix in (".png", ".jpg", ".tif", ".bmp", ".webp", ".pgm", ".hdr"):
        pixels = picture[..., 0] if suffix == ".pgm" else picture
        pixels = pixels.astype(np.float32) if suffix == ".hdr" else pixels
        found[suffix] = cv2.imencode(suffix, pixels)[1].tobytes()
    found["16.png"] = cv2.imencode(".png", picture.astype(np.uint16) * 99)[1].tobytes()
    with tempfile.TemporaryDirectory() as place:
        file = f"{place}/a.exr"
        OpenEXR.File({}, {"RGB": picture.astype(np.float32)}).write(file)
        found[".exr"] = Path(file).read_bytes()
    shipped = weights.weights_path("tiny").read_bytes()
    return [*found.values(), shipped[:5000], CONFIG.encode(), b'{"files": {}}']


EXAMPLES = _examples()


@st.composite
def contents(draw):
    """A file's bytes: none, any, or those of an example cut off or altered."""
    kind = draw(st.sampled_from(["whole", "cut", "altered", "any", "text"]))
    if kind == "any":
        return draw(st.binary(max_size=200))
    if kind == "text":
        return draw(st.text(max_size=100)).encode(errors="surrogatepass")
    data = draw(st.sampled_from(EXAMPLES))
    if kind == "cut":
        return data[: draw(st.integers(0, len(data)))]
    if kind == "altered":
        altered = bytearray(data)
        for _ in range(draw(st.integers(1, 8))):
            place = draw(st.integers(0, min(len(data) - 1, 400)))
            altered[place] = draw(st.integers(0, 255))
        return bytes(altered)
    return data


NAMES = st.sampled_from(
    ["L_0.png", "L_1.jpg", "02.tif", "a.exr", "b.webp", "c.pgm", "d.hdr", "x.gif"]
    + ["e.dng", "f.avif", "g.tga", "h.lp", "i.mp4"]
    + [
        "mask.png",
        "mask.jpg",
        "normal.tif",
        "e.heic",
        "-o.png",
        "\u7d75 \U0001f600.png",
    ]
    + ["n" * 240 + ".png", "meta.json", "normals.json", "w.safetensors", "config.py"]
)
KINDS = st.sampled_from(["file"] * 12 + ["loop", "broken", "folder", "pipe"])
FILES = st.dictionaries(NAMES, st.tuples(KINDS, contents()), max_size=6)
# Paths below a folder that holds "in/object.data", filled with the files.
PATHS = st.sampled_from(
    ["in/object.data", "in", "in/none", "in/object.data/L_0.png", ".", "out", "loop"]
    + ["in/object.data/mask.png", "in/object.data/w.safetensors", "tiny", "n" * 300]
    + ["in/object.data/02.tif", "in/object.data/i.mp4"]
    + ["in/object.data/config.py", "", "/dev/null", "/proc/x", "f.png"]
)
WORDS = st.one_of(
    PATHS,
    st.sampled_from(["-1", "0", "1", "3", "8", "1e3", "nan", "x", "all", "linear"]),
    st.text(max_size=8).filter(lambda word: "\0" not in word),  # nor can the system
)
OPTIONS = {
    "estimate": "--mask --max-images --seed --transfer --reader --size --weights "
    "--normal-map --exr --overwrite --dark --register",
    "check": "--mask --include --exclude --transfer --max-pixels --json",
    "demo": "--weights",
    "eval": "--benchmark --root --method --objects --num-images --crop-size --seed "
    "--protocol --weights --no-pictures",
    "render": "--objects --images --size --seed --sheet --engine --preset --meshes",
    "validate": "--scenes --images --size --light --weights --json",
    "surface": "--mask --photograph --focal --prior --scale --max-faces --mesh --cut "
    "--normal-map",
    "train": "--optim.learning-rate --data.root --train.steps --mesh.fsdp "
    "--init-weights",
}
# What makes a command whole, so that not all cases end at what is missing.
WHOLE = {
    "estimate": ["in/object.data", "-o", "out"],
    "check": ["in/object.data"],
    "demo": ["-o", "out"],
    "eval": ["--benchmark", "folder", "--root", "in", "--workdir", "out", "-m", "sh1"],
    "render": ["-o", "out"],
    "surface": ["in/object.data/L_0.png", "-o", "out"],
    "validate": [],
    "train": ["--config", "in/object.data/config.py", "--workdir", "out"],
}


@st.composite
def cases(draw):
    """The files of a folder, and a command's arguments."""
    name = draw(st.sampled_from(sorted(OPTIONS)))
    arguments = list(WHOLE[name])
    if arguments and draw(st.integers(0, 3)) == 0:
        place = draw(st.integers(0, len(arguments) - 1))
        arguments[place] = draw(WORDS)
    chosen = st.sampled_from([*OPTIONS[name].split(), "--none"])
    for option in draw(st.lists(chosen, max_size=3)):
        arguments += [option, *draw(st.lists(WORDS, max_size=2))]
    return draw(FILES), [name, *arguments]
