"""Measures lights, base colour, texture maps and confidence on held-out scenes.

    python tools/lights.py --scenes 10 --seeds 100 101 102
    python tools/lights.py --scenes 16 --seeds 77 --confidence
    python tools/lights.py --scenes 0 --diligent FOLDER --confidence

Scenes are rendered at 96 x 96 pixels, 8 photographs each, with linear response, and
estimated with the shipped weights. FOLDER is DiLiGenT's `pmsData`, of whose objects 10
photographs are taken. Prints one JSON object with all figures:

lights: the mean angle between directions and the truth, by the network's guesses, by
least squares, and of the constant (0, 0, 1);
base colours: PSNR up to one factor, peak the 99th percentile of the truth, beside the
photographs' mean and one colour; metals are left out;
texture maps: PSNR against the photographs;
confidence: the mean error by spread, and the error that is left when the least reliable
pixels are taken out.
"""

import dataclasses
import json
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import tyro

import unips_jax
from unips_jax.estimation.confidence import normal_spread
from unips_jax.estimation.lights import guess_lights
from unips_jax.lighting.files import base_color
from unips_jax.lighting.lights import estimate_lights
from unips_jax.lighting.ptm import write_ptm
from unips_jax.scenes import SceneConfig
from unips_jax.scenes.config import LIGHT_KINDS

_CONFIG = SceneConfig(linear_rate=1.0)
_EDGES = (0, 1, 2, 3, 4, 6, 8, 10, 15, 20, 30, 180)  # degrees of spread
_DIRECTED = 0.2  # mean directions shorter than this have no direction to speak of


@dataclasses.dataclass(frozen=True)
class Options:
    """What to measure on.

    Attributes:
        scenes: how many of each seed.
        seeds: of scenes.
        diligent: DiLiGenT's folder `pmsData`, if there is one.
        confidence: measure it too, which takes longest.
    """

    scenes: int = 10
    seeds: tuple[int, ...] = (100, 101, 102)
    diligent: Path | None = None
    confidence: bool = False


class Case(NamedTuple):
    """One object, its truth and its estimate."""

    kind: str
    images: np.ndarray
    mask: np.ndarray
    normals: np.ndarray
    directions: np.ndarray
    color: np.ndarray | None
    metal: float


def main() -> None:
    """Measures and prints."""
    options = tyro.cli(Options, description=__doc__)
    config, params = unips_jax.load_weights("tiny")
    rows, spreads = [], []
    for case in _cases(options):
        known = (params, case.images, case.mask)
        found = unips_jax.estimate_photographs(*known, config=config)
        guesses = guess_lights(*known, config=config)
        rows.append(_row(case, found, guesses))
        if options.confidence:
            spread = normal_spread(*known, found, config=config)
            inside = case.mask & (np.abs(case.normals).sum(-1) > 0)
            error = _angles(found, case.normals)
            spreads.append((case.kind, spread[inside], error[inside]))
        print(rows[-1], file=sys.stderr, flush=True)
    kinds = dict.fromkeys(row["kind"] for row in rows)
    figures: dict[str, Any] = {
        kind: _means([row for row in rows if row["kind"] == kind]) for kind in kinds
    }
    textured = [row for row in rows if row.get("texture", 0) > 0.2]
    figures["textured"] = _means(textured)
    figures["all"] = _means(rows)
    if spreads:
        figures["confidence"] = _confidence(spreads)
    print(json.dumps(figures, indent=1))


def _cases(options: Options) -> Iterator[Case]:
    render = _renderer()
    keys = [
        key
        for seed in options.seeds
        for key in jax.random.split(jax.random.key(seed), options.scenes)
    ]
    for key in keys:
        scene, surface = render(key)
        size = scene.mask.shape
        yield Case(
            LIGHT_KINDS[int(scene.light_kind)],
            np.asarray(scene.images),
            np.asarray(scene.mask),
            np.asarray(scene.normals),
            np.asarray(scene.light_means),
            np.asarray(surface.base_color).T.reshape(*size, 3),
            float(np.asarray(surface.metallic).reshape(size)[scene.mask].mean()),
        )
    if options.diligent is not None:
        yield from _diligent(options.diligent)


def _renderer() -> Callable[[jax.Array], Any]:
    from unips_jax.scenes.geometry import render_geometry
    from unips_jax.scenes.materials import draw_surface
    from unips_jax.scenes.render import shade
    from unips_jax.scenes.shading import split
    from unips_jax.scenes.tracing import object_point

    def render(key: jax.Array) -> Any:
        key_geometry, key_shade = jax.random.split(key)
        geometry = render_geometry(key_geometry, size=96, config=_CONFIG)
        scene = shade(key_shade, geometry, num_images=8, config=_CONFIG)
        # The same material once more, as `shade` draws it.
        key_surface = jax.random.split(key_shade, 4)[1]
        shape = geometry.shape
        point = object_point(shape, geometry.to_object, split(geometry.positions))
        scaled = tuple(c / shape.radius for c in point)
        height = geometry.height.reshape(-1)
        return scene, draw_surface(key_surface, scene.material, scaled, height)  # type: ignore[arg-type]

    return jax.jit(render)


def _diligent(root: Path) -> Iterator[Case]:
    import scipy.io

    from unips_jax.io.images import read_image_file
    from unips_jax.io.masks import read_mask

    for folder in sorted(root.glob("*PNG")):
        names = (folder / "filenames.txt").read_text().split()
        pick = np.linspace(0, len(names) - 1, 10).round().astype(int)
        images = [read_image_file(folder / names[index]).pixels for index in pick]
        truth = scipy.io.loadmat(folder / "Normal_gt.mat")["Normal_gt"]
        directions = np.loadtxt(folder / "light_directions.txt")[pick]
        mask = read_mask(folder / "mask.png")
        name = folder.name.removesuffix("PNG")
        normals = truth.astype(np.float32)
        yield Case(name, np.stack(images), mask, normals, directions, None, 0)


def _row(case: Case, found: np.ndarray, guesses: np.ndarray | None) -> dict[str, Any]:
    row: dict[str, Any] = {"kind": case.kind}
    directed = np.linalg.norm(case.directions, axis=-1) > _DIRECTED
    lights = estimate_lights(case.images, found, case.mask, guesses=guesses)
    if directed.any():
        plain = estimate_lights(case.images, found, case.mask)
        exact = estimate_lights(case.images, case.normals, case.mask)
        for name, directions in (
            ("network", lights.directions),
            ("least squares", plain.directions),
            ("least squares, true normals", exact.directions),
            ("constant", np.array([[0.0, 0, 1]])),
        ):
            angles = _angles(directions, case.directions)[directed]
            row[name] = float(angles.mean())
    facts = write_ptm(Path(os.devnull), case.images, case.mask, lights)
    row["ptm"] = facts["psnr_db"]
    if case.color is not None and case.metal < 0.5:
        inside = case.mask & (np.abs(case.normals).sum(-1) > 0)
        truth = case.color[inside].astype(float)
        color = base_color(case.images, found, case.mask, lights)[inside]
        bright = case.images[:, inside]
        bright = (bright / bright.mean((1, 2), keepdims=True)).mean(0)
        row["base colour"] = _psnr(color, truth)
        row["mean photograph"] = _psnr(bright, truth)
        row["one colour"] = _psnr(np.ones_like(truth), truth)
        row["texture"] = float(np.log(truth + 1e-3).std(0).mean())
    return row


def _angles(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    length = np.maximum(np.linalg.norm(truth, axis=-1), 1e-9)
    return np.degrees(np.arccos(np.clip((found * truth).sum(-1) / length, -1, 1)))


def _psnr(found: np.ndarray, truth: np.ndarray) -> float:
    factor = (found * truth).sum() / np.square(found).sum()
    peak = np.quantile(truth, 0.99)
    return float(-10 * np.log10(np.square(factor * found - truth).mean() / peak**2))


def _means(rows: list[dict[str, Any]]) -> dict[str, float]:
    names = dict.fromkeys(name for row in rows for name in row if name != "kind")
    means = {
        name: round(float(np.mean([row[name] for row in rows if name in row])), 2)
        for name in names
    }
    return {"objects": len(rows), **means}


def _confidence(spreads: list[tuple[str, np.ndarray, np.ndarray]]) -> dict[str, Any]:
    """Every object weighs the same."""
    spread = np.concatenate([s for _, s, _ in spreads])
    error = np.concatenate([e for *_, e in spreads])
    weight = np.concatenate([np.full(len(s), 1 / len(s)) for _, s, _ in spreads])
    bins = np.digitize(spread, _EDGES[1:-1])
    table = []
    for index in range(len(_EDGES) - 1):
        there = bins == index
        if there.sum() > 50:
            mean = [
                np.average(x[there], weights=weight[there]) for x in (spread, error)
            ]
            share = weight[there].sum() / weight.sum()
            table.append([round(float(x), 3) for x in (*mean, share)])

    def left(order: np.ndarray, kept: float) -> float:
        cumulated = np.cumsum(weight[order]) / weight.sum()
        first = order[cumulated <= kept]
        return round(float(np.average(error[first], weights=weight[first])), 2)

    shares = (1.0, 0.9, 0.8, 0.7, 0.5, 0.3)
    return {
        "spread, error, share": table,
        "kept": shares,
        "error left": [left(np.argsort(spread), share) for share in shares],
        "error left, best possible": [left(np.argsort(error), x) for x in shares],
    }


if __name__ == "__main__":
    main()
