"""Makes the parts of the viewer's page that are not written by hand.

    python tools/bundle_viewer.py

Needs `npm`. Bundles what the viewer uses of three.js (MIT) into one file, with the
versions and hashes of `tools/viewer/package-lock.json`, next to its licence. Writes the
environments' light as spherical harmonics, from the tables that ship
(`unips_jax/assets/environments.npz`, by Poly Haven, CC0-1.0).
"""

import argparse
import json
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from unips_jax.console import command
from unips_jax.errors import InputError
from unips_jax.io.door import write_whole
from unips_jax.scenes.environments import TABLE_SIZE, directions_of, load_tables

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ROOT / "tools" / "viewer"
ASSETS = ROOT / "unips_jax" / "viewer" / "assets"
ENVIRONMENTS = {"workshop": 15, "forest": 5, "lobby": 8, "sunset": 12}
"""Numbers in the tables, which are sorted by name."""


def bundle() -> tuple[bytes, bytes]:
    """Bundles three.js: the script, which defines `THREE`, and the licence.

    Raises:
        InputError: if npm fails, as it does where an archive has another hash.
    """
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        for path in SOURCES.iterdir():
            shutil.copy(path, work)
        _run(work, "npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund")
        package = work / "node_modules" / "three"
        version = json.loads((package / "package.json").read_text())["version"]
        banner = f"/* three.js {version}, MIT licence: see three.LICENSE */"
        words = (
            "npx --no-install esbuild three.js --bundle --minify --format=iife "
            "--global-name=THREE --outfile=three.min.js --legal-comments=inline "
            "--charset=ascii"
        )
        _run(work, *words.split(), f"--banner:js={banner}")
        return (work / "three.min.js").read_bytes(), (package / "LICENSE").read_bytes()


def _run(folder: Path, *words: str) -> None:
    try:
        subprocess.run(words, cwd=folder, check=True, capture_output=True, text=True)
    except FileNotFoundError:
        raise InputError(f"{words[0]}: expected npm, got none; install it") from None
    except subprocess.CalledProcessError as error:
        reason = " ".join(error.stderr.split())[-300:]
        raise InputError(f"{' '.join(words[:2])} failed: {reason}") from None


def irradiance() -> dict[str, list[list[float]]]:
    """The light that a white surface reflects, by its normal, as nine harmonics.

    Returns:
        For each environment `[9, 3]`, for the basis 1, y, z, x, xy, yz, 3z^2 - 1, zx,
        x^2 - y^2, with the mean over all normals 1.

    Source: Ramamoorthi, Hanrahan, An efficient representation for irradiance
    environment maps, SIGGRAPH 2001, equations 1 to 10.
    """
    tables = load_tables()
    towards, solid = directions_of(*TABLE_SIZE)
    scales = np.array([0.282095] + [0.488603] * 3 + [1.092548] * 5)
    scales[6], scales[8] = 0.315392, 0.546274
    lobe = np.array([1.0] + [2 / 3] * 3 + [1 / 4] * 5)  # of pi: the cosine's
    found = {}
    for name, number in ENVIRONMENTS.items():
        weights = _basis(towards) * scales * solid[..., None]
        light = np.einsum("hwk,hwc->kc", weights, tables.radiance[number, 0])
        sun = _basis(tables.sun_directions[number]) * scales
        light += sun[:, None] * tables.sun_colors[number]
        values = light * (lobe * scales)[:, None]
        found[name] = np.round(values / values[0].mean(), 4).tolist()
    return found


def _basis(n: np.ndarray) -> np.ndarray:
    x, y, z = np.moveaxis(np.asarray(n, float), -1, 0)
    parts = [x * 0 + 1, y, z, x, x * y, y * z, 3 * z**2 - 1, z * x, x**2 - y**2]
    return np.stack(parts, -1)


@command
def main(argv: Sequence[str] | None = None) -> None:
    """Writes the assets."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.parse_args(argv)
    script, licence = bundle()
    write_whole(ASSETS / "three.min.js", script)
    write_whole(ASSETS / "three.LICENSE", licence)
    text = json.dumps(irradiance()) + "\n"
    write_whole(ASSETS / "environments.json", text.encode())
    print(f"wrote {ASSETS}: three.js, {len(script) / 1e3:.0f} kB")


if __name__ == "__main__":
    raise SystemExit(main())
