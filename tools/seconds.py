"""Seconds that a user waits: whole commands cold and warm, first calls, and growth.

    python tools/seconds.py [-o docs/results/seconds.json] [--quick]

Cold is the first run with an empty cache, warm the next. CPU seconds are those of the
process and all it started, by the operating system; on a busy machine they are what
counts, and wall seconds only say that it was busy. `tools/results.py` shows the file.
The images are noise under a disc mask: what is computed does not depend on them.
"""

import argparse
import datetime
import functools
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from unips_jax.console import command
from unips_jax.io.images import write_image
from unips_jax.weights import weights_record

# Images and their side; 74 thousand pixels of 640 x 640 are masked.
SETS = ((4, 256), (10, 512), (32, 512))
COUNTS, SIDES = (2, 4, 8, 16, 32, 64), (256, 512, 1024, 2048)

_IN_JAX = """
import jax, sys, unips_jax
unips_jax.cache_compilations()
network = unips_jax.load_weights("tiny")
images = jax.random.uniform(jax.random.key(0), ({n}, {side}, {side}, 3))
y, x = jax.numpy.mgrid[-1:1:{side}j, -1:1:{side}j]
def tilt(images):
    return unips_jax.estimate_normals(network, images, x**2 + y**2 < 0.7)[..., 0].sum()
jax.block_until_ready((jax.grad(tilt) if {gradient} else tilt)(images))
"""
_SURFACE = """
import jax, numpy as np, unips_jax
unips_jax.cache_compilations()
y, x = np.mgrid[-1:1:{side}j, -1:1:{side}j].astype(np.float32)
mask = x**2 + y**2 < 0.9
normals = np.stack([x, -y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], -1)
unips_jax.integrate_image(normals * mask[..., None], mask)
"""


def main_processor() -> str:
    """The processor's name and the number of its cores that may be used."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = info.read_text().splitlines()
        found = [line.split(":")[1] for line in lines if line.startswith("model name")]
        name = found[0].strip() if found else name
    return f"{name}, {len(os.sched_getaffinity(0))} cores"


def measured(arguments: Sequence[str], cache: Path) -> dict[str, float]:
    """CPU seconds, wall seconds and peak memory of a process of this Python."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(cache)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    start = time.perf_counter()
    child = subprocess.Popen(
        [sys.executable, *arguments], env=environment, stdout=subprocess.DEVNULL
    )
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if status:
        raise SystemExit(f"{' '.join(arguments)[:80]}: ended with status {status}")
    return {
        "cpu": round(used.ru_utime + used.ru_stime, 1),
        "wall": round(time.perf_counter() - start, 1),
        "gb": round(used.ru_maxrss / 1e6, 2),
    }


def write_photographs(folder: Path, count: int, side: int, mask: np.ndarray) -> None:
    """Photographs of noise, 8 bits, and their mask."""
    folder.mkdir()
    generator = np.random.default_rng(0)
    for index in range(count):
        picture = generator.integers(30, 220, (side, side, 3), np.uint8)
        write_image(folder / f"{index:02}.png", picture)
    write_image(folder / "mask.png", mask.astype(np.uint8) * 255)


def disc(side: int, pixels: int | None = None) -> np.ndarray:
    """A round mask, of 55 % of a square, or of about this number of pixels."""
    y, x = np.mgrid[-1 : 1 : side * 1j, -1 : 1 : side * 1j]
    bound = 0.7 if pixels is None else 4 * pixels / (np.pi * side**2)
    return x**2 + y**2 < bound


def commands(folder: Path) -> dict[str, list[str]]:
    """What is run, by the name that the table shows."""
    write_photographs(folder / "photographs", 8, 640, disc(640, 74_000))
    base = ["-m", "unips_jax"]
    estimate = [*base, "estimate", str(folder / "photographs"), "--overwrite"]
    estimate += ["-o", str(folder / "out")]
    runs = {
        "`unips estimate`, 8 x 640 x 640": estimate,
        "the same with `--fast`": [*estimate, "--fast"],
        "`unips demo`": [*base, "demo", "-o", str(folder / "demo")],
        "`unips eval --help`": [*base, "eval", "--help"],
        "surface of 2048 x 2048": ["-c", _SURFACE.format(side=2048)],
    }
    for n, side in SETS:
        code = _IN_JAX.format(n=n, side=side, gradient=False)
        runs[f"`estimate_normals`, {n} x {side} x {side}"] = ["-c", code]
    for gradient, name in ((False, "`estimate_normals`"), (True, "its gradient")):
        code = _IN_JAX.format(n=4, side=64, gradient=gradient)
        runs[f"{name}, 4 x 64 x 64"] = ["-c", code]
    return runs


def growth(counts: Sequence[int], sides: Sequence[int]) -> dict[str, list[Any]]:
    """CPU seconds of `estimate_photographs`, compiled, by images and by pixels."""
    import unips_jax

    unips_jax.cache_compilations()
    network = unips_jax.load_weights("tiny")

    def seconds(count: int, side: int) -> float:
        generator = np.random.default_rng(0)
        images = generator.integers(30, 220, (count, side, side, 3), np.uint8)
        run: Callable[[], Any] = functools.partial(
            unips_jax.estimate_photographs, network, images, disc(side)
        )
        run()
        before = resource.getrusage(resource.RUSAGE_SELF)
        run()
        after = resource.getrusage(resource.RUSAGE_SELF)
        spent = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
        return round(spent, 2)

    return {
        "images": [[n, seconds(n, 128)] for n in counts],
        "side": [[side, seconds(4, side)] for side in sides],
    }


@command
def main(argv: Sequence[str] | None = None) -> None:
    """Measures, and prints or writes JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--output", type=Path, help="a file; else printed")
    parser.add_argument("--quick", action="store_true", help="small sizes alone")
    arguments = parser.parse_args(argv)
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for title, given in commands(folder).items():
            if arguments.quick and "help" not in title and "64 x 64" not in title:
                continue
            cache = folder / "cache" / str(len(rows))
            cold, warm = (measured(given, cache) for _ in range(2))
            rows.append({"what": title, "cold": cold, "warm": warm})
            print(title, cold, warm, file=sys.stderr, flush=True)
    import jax

    small = arguments.quick
    found = {
        "hash": weights_record("tiny")["hash"],
        "date": datetime.date.today().isoformat(),
        "processor": main_processor(),
        "jax": jax.__version__,
        "rows": rows,
        "growth": growth(*((2, 4), (64, 128)) if small else (COUNTS, SIDES)),
    }
    text = json.dumps(found, indent=1) + "\n"
    if arguments.output is None:
        print(text, end="")
    else:
        arguments.output.write_text(text)


if __name__ == "__main__":
    sys.exit(main())
