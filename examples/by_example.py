"""A method of one's own in the bench: normals by example, in 40 lines.

Each pixel takes the normal of that pixel of a sphere which looks most alike under the
same lamps (orientation consistency: Hertzmann and Seitz, CVPR 2003). The sphere is
computed, matt and with two strengths of highlights. Called from the bench:

    unips eval ... -m unips python:examples.by_example:by_example:neighbours=5

or as a program of its own, in an environment that has neither JAX nor this package:

    unips eval ... --workdir out --write-inputs
    python examples/by_example.py out/inputs by_example
    unips eval ... --workdir out -m unips files:by_example
"""

import sys
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree


def by_example(*, neighbours: int = 5):
    """Normals by example, from a computed sphere (Hertzmann and Seitz, 2003)."""

    def method(observed):
        lights = observed.lights
        if lights is None:
            from unips_jax.baselines.method import Unsupported

            raise Unsupported("by_example: needs the lights")
        seen = observed.images[:, observed.mask] / lights.intensities[:, None]
        found = look_up(seen.mean(-1).T, lights.directions, neighbours)
        normals = np.zeros((*observed.mask.shape, 3), np.float32)
        normals[observed.mask] = found
        return normals

    return method


def look_up(seen, lamps, neighbours):
    """Normals `[P, 3]` of pixels `[P, N]` under lamps `[N, 3]`."""
    y, x = np.mgrid[1:-1:161j, -1:1:161j]
    inside = x * x + y * y < 0.999
    sphere = np.stack([x, y, np.sqrt(np.maximum(1 - x * x - y * y, 0))], -1)[inside]
    matt = np.maximum(sphere @ lamps.T, 0)
    shine = np.maximum(sphere @ unit(lamps + (0, 0, 1)).T, 0) ** 30 * (matt > 0)
    examples = unit(np.concatenate([matt + gloss * shine for gloss in (0, 0.3, 1)]))
    distance, place = cKDTree(examples).query(unit(seen), k=neighbours)
    weight = 1 / np.maximum(distance.reshape(len(seen), -1, 1), 1e-9)
    normals = sphere[place.reshape(len(seen), -1) % len(sphere)]
    return unit((normals * weight).sum(1))


def unit(vectors):
    """Vectors `[..., C]` of length 1; 0 stays 0."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.maximum(length, 1e-9)


def main(inputs, outputs):
    """From a folder that `unips eval --write-inputs` wrote to a `.npy` per object."""
    import cv2

    for folder in sorted(Path(inputs).glob("*.data")):
        if not (folder / "light_directions.txt").exists():
            print(f"{folder.name}: its lights are not known, left out")
            continue
        files = sorted(folder.glob("L_*.png"))
        images = np.stack(
            [cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in files]
        )
        mask = cv2.imread(str(folder / "mask.png"), cv2.IMREAD_UNCHANGED) > 0
        lamps = np.loadtxt(folder / "light_directions.txt")
        power = np.loadtxt(folder / "light_intensities.txt")[:, ::-1]  # OpenCV has BGR
        seen = (images[:, mask] / power[:, None]).mean(-1).T
        normals = np.zeros((*mask.shape, 3), np.float32)
        normals[mask] = look_up(seen, lamps, 5)
        Path(outputs).mkdir(parents=True, exist_ok=True)
        np.save(Path(outputs) / f"{folder.stem}.npy", normals)


if __name__ == "__main__":
    main(*sys.argv[1:])
