"""Normal integration: its speed next to SciPy's conjugate gradients, and its figure.

    python tools/surface.py [--size 1024] [--noise 0.05] [--plain-size 512]
    python tools/surface.py --figure docs/surface-step.png

Prints one JSON line. A hemisphere of `--plain-size` is integrated by plain least
squares, by the package's solver and by `scipy.sparse.linalg.cg`, on the same equations
with the same tolerance. Then one of `--size`, whose normals are noisy, is integrated as
`unips surface` does, with the memory that took. Seconds are of processor time, of all
threads together, so that other work on the machine counts little; the wall clock shows
at most as many where the machine is idle.
"""

import argparse
import functools
import json
import resource
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from unips_jax.console import cache_compilations
from unips_jax.surface.equations import Edges, balance, statements, system
from unips_jax.surface.images import integrate_image
from unips_jax.surface.multigrid import Springs, conjugate_gradients

_T = TypeVar("_T")
_TOLERANCE = 1e-5
_FAINT = 1e-5


def hemisphere(size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Exact normals `[H, W, 3]`, mask and depth `[H, W]`, and the radius in pixels."""
    row, column = np.mgrid[:size, :size].astype(np.float32)
    radius = 0.49 * size
    x, y = (column - (size - 1) / 2) / radius, -(row - (size - 1) / 2) / radius
    mask = x**2 + y**2 < 1
    z = np.sqrt(np.where(mask, 1 - x**2 - y**2, 0))
    return np.stack([x, y, z], -1) * mask[..., None], mask, -radius * z, radius


def cut_waves(size: int, amplitude: float) -> tuple[np.ndarray, np.ndarray]:
    """Normals and depth of a cosine sheet above the middle row, its negative below."""
    row, column = np.mgrid[:size, :size].astype(np.float32)
    rate = 4 * np.pi / size
    sign = np.where(row < size / 2, 1, -1)
    across = -sign * amplitude * rate * np.sin(rate * column)
    normals = np.stack([-across, np.zeros_like(across), np.ones_like(across)], -1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return normals, -sign * amplitude * np.cos(rate * column)


def compare_solvers(size: int) -> dict[str, float]:
    """Seconds and steps of both solvers on the plain least squares of a hemisphere."""
    normals, mask, _, _ = hemisphere(size)
    stated = statements(jnp.asarray(normals), jnp.asarray(mask), None, None)
    stiffness, asked = system(stated, jnp.zeros_like(stated.m), 0.0)
    force = balance(Edges(*(s * a for s, a in zip(stiffness, asked, strict=True))))
    faint = Edges(*(jnp.where(s > 0, s + _FAINT, 0) for s in stiffness))
    springs = Springs(faint, jnp.zeros_like(stated.m))
    solve = jax.jit(
        functools.partial(conjugate_gradients, tolerance=_TOLERANCE, max_steps=100)
    )
    jax.block_until_ready(solve(springs, force))
    seconds, (_, steps) = _timed(lambda: jax.block_until_ready(solve(springs, force)))
    plain_seconds, plain_steps = _plain(faint, np.asarray(force, np.float64), mask)
    return {
        "size": size,
        "multigrid_cpu_s": seconds,
        "multigrid_steps": int(steps),
        "plain_cpu_s": plain_seconds,
        "plain_steps": plain_steps,
        "ratio": plain_seconds / seconds,
    }


def _plain(stiffness: Edges, force: np.ndarray, mask: np.ndarray) -> tuple[float, int]:
    import scipy.sparse
    import scipy.sparse.linalg

    index = np.cumsum(mask.ravel()).reshape(mask.shape) - 1
    right, down = (np.asarray(each, np.float64) for each in stiffness)
    across, below = right > 0, down > 0
    weights = np.concatenate([right[across], down[below]])
    first = np.concatenate([index[across], index[below]])
    second = np.concatenate([index[:, 1:][across[:, :-1]], index[1:][below[:-1]]])
    count = int(mask.sum())
    half = scipy.sparse.coo_array((-weights, (first, second)), (count, count))
    matrix = (half + half.T).tocsr()
    matrix = matrix - scipy.sparse.diags_array(matrix.sum(axis=1))
    steps = 0

    def counted(_: np.ndarray) -> None:
        nonlocal steps
        steps += 1

    seconds, _ = _timed(
        lambda: scipy.sparse.linalg.cg(
            matrix.tocsr(), force[mask], rtol=_TOLERANCE, callback=counted
        )
    )
    return seconds, steps


def _timed(function: Callable[[], _T]) -> tuple[float, _T]:
    start = time.process_time()
    result = function()
    return time.process_time() - start, result


def integrate_noisy(size: int, noise: float) -> dict[str, float]:
    """Time, memory and error of a whole integration."""
    normals, mask, truth, radius = hemisphere(size)
    rng = np.random.default_rng(0)
    normals += rng.normal(0, noise, normals.shape).astype(np.float32) * mask[..., None]
    integrate_image(normals, mask, max_rounds=1)  # compiles
    before = _peak_gb()
    seconds, found = _timed(lambda: integrate_image(normals, mask))
    error = found.depth[mask] - truth[mask]
    return {
        "size": size,
        "noise": noise,
        "cpu_s": seconds,
        "rounds": found.rounds,
        "mean_error_of_radius": float(np.abs(error - error.mean()).mean() / radius),
        "peak_gb": max(before, _peak_gb()),
        "inputs_gb": (normals.nbytes + mask.nbytes + truth.nbytes) / 1e9,
    }


def _peak_gb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def draw_figure(path: Path) -> None:
    """Draws a cut sheet: true, by plain least squares, and with weights."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    size = 96
    normals, truth = cut_waves(size, 20)
    plain = integrate_image(normals, max_rounds=0).depth
    found = integrate_image(normals).depth
    figure = plt.figure(figsize=(11, 3), layout="constrained")
    row, column = np.mgrid[:size, :size]
    for place, depth, title in (
        (1, truth, "true surface"),
        (2, plain, "plain least squares"),
        (3, found, "bilateral weights"),
    ):
        axes = figure.add_subplot(1, 4, place, projection="3d")
        height = -(depth - depth.mean())
        axes.plot_surface(column, -row, height, rstride=2, cstride=2, cmap="viridis")
        error = np.abs(depth - depth.mean() - truth + truth.mean()).mean()
        more = "" if place == 1 else f"\nmean error {error:.2f} pixels"
        axes.set_title(title + more, fontsize=9)
        axes.set(zlim=(-22, 22), xticks=[], yticks=[], zticks=[-20, 0, 20])
        axes.view_init(35, -70)
    axes = figure.add_subplot(1, 4, 4)
    for depth, style in ((truth, "k-"), (plain, "C1--"), (found, "C0.")):
        axes.plot(-(depth - depth.mean())[:, 48], style, markersize=4)
    axes.legend(["true", "plain", "weights"], fontsize=8)
    axes.set_title("height along the middle column", fontsize=9)
    axes.set_xlabel("row, pixels", fontsize=8)
    figure.savefig(path, dpi=90)


def main(argv: Sequence[str] | None = None) -> None:
    """Measures, or draws."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--noise", type=float, default=0.05)
    parser.add_argument("--plain-size", type=int, default=512)
    parser.add_argument("--figure", type=Path)
    options = parser.parse_args(argv)
    cache_compilations()
    if options.figure is not None:
        draw_figure(options.figure)
        return
    facts = {
        "solvers": compare_solvers(options.plain_size),
        "integration": integrate_noisy(options.size, options.noise),
    }
    print(json.dumps(facts))


if __name__ == "__main__":
    main()
