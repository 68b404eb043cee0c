"""Measures what is estimated next to normals: lights, colour, depth, confidence.

    python tools/maps.py --scenes 10 --diligent FOLDER --ps-wild FOLDER
    python tools/maps.py --scenes 5 --diligent FOLDER --ps-wild FOLDER --confidence

Of three sources: scenes of `SceneConfig` with linear response at 96 x 96 pixels, 8
photographs each; ten photographs of each object in DiLiGenT's `pmsData`; sets that
`unips render --engine cycles` wrote. Each is left out if not named. Prints one JSON
object with the means of every source and kind, over objects that have such a truth:

lights: the angle between directions and the truth, by the network's guesses, by least
squares, and of the constant (0, 0, 1); the lamp's where it gives a quarter of the
light or more, and in a set's mixed light, else the mean's; without photographs whose
mean direction is shorter than 0.2;
colors: PSNR up to one factor, peak the 99th percentile of the truth, with the
photographs' mean and one colour, metals left out; and of texture maps against the
photographs;
depth: the mean distance from the truth, in percent of the object's longer side, after
the best shift (of a perspective camera, the best factor), of the estimated normals and
the true ones, with a plane and a half ball over the object;
confidence (alone, with `--confidence`): the mean error that is left when the pixels of
the largest spreads are taken out, with the least possible, and the error by spread.
"""

import dataclasses
import functools
import json
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import OpenEXR
import scipy.ndimage
import tyro

import unips_jax
from unips_jax.console import command
from unips_jax.estimation.confidence import normal_spread
from unips_jax.estimation.extras import key_lights
from unips_jax.estimation.streaming import estimate_with_lights
from unips_jax.evaluation.benchmarks.base import Item
from unips_jax.evaluation.benchmarks.diligent import Diligent
from unips_jax.evaluation.benchmarks.ps_wild import PSWildTest
from unips_jax.io.images import read_image_file
from unips_jax.lighting.light_files import base_color
from unips_jax.lighting.light_fit import estimate_lights
from unips_jax.lighting.ptm import fit_texture_map, write_ptm
from unips_jax.models.network import Lamps
from unips_jax.scenes import SceneConfig
from unips_jax.scenes.config import LIGHT_KINDS
from unips_jax.surface.images import integrate_image

_CONFIG = SceneConfig(linear_rate=1.0)
_EDGES = (0, 1, 2, 3, 4, 6, 8, 10, 15, 20, 30, 180)  # degrees of spread
_KEPT = (1.0, 0.9, 0.8, 0.7, 0.5, 0.3)
_DIRECTED = 0.2  # mean directions shorter than this have no direction to speak of
_OBJECTS = ("ball", "cow", "pot1", "reading")
_ALL = "all"


@dataclasses.dataclass(frozen=True)
class Options:
    """What to measure on.

    Attributes:
        scenes: how many of each seed.
        seeds: of scenes.
        diligent: DiLiGenT's folder, if there is one.
        ps_wild: a set that `unips render --engine cycles` wrote, if there is one.
        confidence: measure it, and nothing else.
        weights: shipped name or file.
    """

    scenes: int = 0
    seeds: tuple[int, ...] = (100, 101, 102)
    diligent: Path | None = None
    ps_wild: Path | None = None
    confidence: bool = False
    weights: str = "tiny"


class Case(NamedTuple):
    """One object and what is known of it: `None` where it is not.

    Attributes:
        source: where it is from.
        kind: of light, or its name.
        images: `[N, H, W, 3]`, linear.
        mask: `[H, W]`, bool.
        normals: `[H, W, 3]`, true ones, 0 where there is none.
        directions: `[N, 3]`, true ones of light, shorter where it is less direct.
        color: `[H, W, 3]`, the true base colour, if the object is no metal.
        depth: `[H, W]`, in pixels of an orthographic camera, else up to a factor.
        focal: in pixels; None for an orthographic camera.
    """

    source: str
    kind: str
    images: np.ndarray
    mask: np.ndarray
    normals: np.ndarray
    directions: np.ndarray | None = None
    color: np.ndarray | None = None
    depth: np.ndarray | None = None
    focal: float | None = None

    @property
    def inside(self) -> np.ndarray:
        """Pixels with a true normal."""
        return self.mask & (np.abs(self.normals).sum(-1) > 0)


class Errors(NamedTuple):
    """The spread and the error of an object's pixels, degrees."""

    spread: np.ndarray
    error: np.ndarray


@command
def main(argv: Sequence[str] | None = None) -> None:
    """Measures and prints."""
    options = tyro.cli(Options, args=argv, description=__doc__)
    network = unips_jax.load_weights(options.weights)
    found: dict[str, dict[str, list[Any]]] = {}
    for case in _cases(options):
        known = (network, case.images, case.mask)
        normals, lights, lamps = estimate_with_lights(*known)
        if options.confidence:
            spread = normal_spread(*known, normals)[case.inside]
            error = _angles(normals, case.normals)[case.inside]
            scores: Any = Errors(spread, error)
        else:
            guesses = key_lights(lights, lamps)  # as `lights.json` has them
            scores = {**_lights(case, normals, guesses), **_depths(case, normals)}
            print(case.source, case.kind, scores, file=sys.stderr, flush=True)
        kinds = found.setdefault(case.source, {})
        for kind in (case.kind, _ALL):
            kinds.setdefault(kind, []).append(scores)
    summary = _confidence if options.confidence else _means
    figures = {
        source: {kind: summary(kinds[kind]) for kind in sorted(kinds, key=_order)}
        for source, kinds in found.items()
    }
    print(json.dumps(figures, indent=1))


def _order(kind: str) -> int:
    last = len(LIGHT_KINDS) + (kind == _ALL)
    return LIGHT_KINDS.index(kind) if kind in LIGHT_KINDS else last


def _cases(options: Options) -> Iterator[Case]:
    render = _renderer()
    for seed in options.seeds:
        for key in jax.random.split(jax.random.key(seed), options.scenes):
            yield _scene(*render(key))
    if options.diligent is not None:
        photographs = Diligent(options.diligent, objects=_OBJECTS)
        for index in range(len(photographs)):
            yield _photographed(photographs[index])
    if options.ps_wild is not None:
        benchmark = PSWildTest(options.ps_wild)
        for index, entry in enumerate(benchmark.entries):
            yield _rendered(benchmark[index], entry.images[0].parent)


def _renderer() -> Callable[[jax.Array], Any]:
    from unips_jax.scenes.geometry import render_geometry
    from unips_jax.scenes.materials import draw_surface
    from unips_jax.scenes.render import shade
    from unips_jax.scenes.shading import split
    from unips_jax.scenes.tracing import object_point

    def render(key: jax.Array) -> Any:
        key_geometry, key_shade = jax.random.split(key)
        geometry = render_geometry(key_geometry, size=96, config=_CONFIG)
        scene = shade(key_shade, geometry, num_images=8, config=_CONFIG, incident=True)
        # The same material once more, as `shade` draws it.
        key_surface = jax.random.split(key_shade, 4)[1]
        shape = geometry.shape
        point = object_point(shape, geometry.to_object, split(geometry.positions))
        scaled = tuple(c / shape.radius for c in point)
        height = geometry.height.reshape(-1)
        return scene, draw_surface(key_surface, scene.material, scaled, height)  # type: ignore[arg-type]

    return jax.jit(render)


def _scene(scene: Any, surface: Any) -> Case:
    size, mask = scene.mask.shape, np.asarray(scene.mask)
    metal = np.asarray(surface.metallic).reshape(size)[mask].mean()
    color = np.asarray(surface.base_color).T.reshape(*size, 3)
    light = scene.incident
    lamps = Lamps(np.asarray(light.lamp_direction), np.asarray(light.lamp_share))
    return Case(
        "scenes",
        LIGHT_KINDS[int(scene.light_kind)],
        np.asarray(scene.images),
        mask,
        np.asarray(scene.normals),
        key_lights(np.asarray(scene.light_means), lamps),
        color if metal < 0.5 else None,
    )


def _photographed(item: Item) -> Case:
    assert item.lights is not None and item.normals is not None
    pick = np.linspace(0, len(item.images) - 1, 10).round().astype(int)
    return Case(
        "DiLiGenT",
        item.tags["object"],
        item.images[pick],
        item.mask,
        item.normals,
        item.lights.directions[pick],
    )


def _rendered(item: Item, folder: Path) -> Case:
    assert item.normals is not None
    meta = json.loads((folder / "meta.json").read_text())
    lamps = [light["lamps"] for light in meta["lights"]]
    color, metal = (
        read_image_file(folder / f"{name}.tif").pixels / 65535
        for name in ("baseColor", "metal")
    )
    focal = meta["focal_mm"] and meta["focal_mm"] / 36 * meta["size"]
    depth = OpenEXR.File(str(folder / "depth.exr")).channels()["Z"].pixels
    return Case(
        folder.parents[1].name,
        item.tags["lighting"],
        item.images,
        item.mask,
        item.normals,
        np.array([lamp[0]["direction"] for lamp in lamps]) if all(lamps) else None,
        color if metal[item.mask].mean() < 0.5 else None,
        depth if focal else depth * meta["size"] / 2,  # the frame is two units wide
        focal,
    )


def _lights(
    case: Case, normals: np.ndarray, guesses: np.ndarray | None
) -> dict[str, float]:
    """Errors of directions and colours."""
    estimate = functools.partial(estimate_lights, case.images)
    lights = estimate(normals, case.mask, guesses=guesses)
    row = {}
    if case.directions is not None:
        directed = np.linalg.norm(case.directions, axis=-1) > _DIRECTED
        for name, directions in (
            ("network", lights.directions),
            ("least squares", estimate(normals, case.mask).directions),
            ("constant", np.array([[0.0, 0, 1]])),
        ):
            angles = _angles(directions, case.directions)[directed]
            if directed.any():
                row[name] = float(angles.mean())
    texture_map = fit_texture_map(case.images, case.mask, lights)
    with tempfile.TemporaryDirectory() as place:
        facts = write_ptm(Path(place) / "relight.ptm", texture_map)
    row["texture map"] = facts["psnr_db"]
    if case.color is not None:
        inside = case.inside
        truth = case.color[inside].astype(float)
        color = base_color(case.images, normals, case.mask, lights)[inside]
        bright = case.images[:, inside].astype(float)
        bright = (bright / bright.mean((1, 2), keepdims=True)).mean(0)
        row["base colour"] = _psnr(color, truth)
        row["mean photograph"] = _psnr(bright, truth)
        row["one colour"] = _psnr(np.ones_like(truth), truth)
    return row


def _depths(case: Case, normals: np.ndarray) -> dict[str, float]:
    """Errors of depth, percent of the object's longer side."""
    if case.depth is None:
        return {}
    integrate = functools.partial(integrate_image, mask=case.inside, focal=case.focal)
    rows, columns = np.nonzero(case.inside)
    side = 1 + int(max(np.ptp(rows), np.ptp(columns)))
    surfaces = {
        "depth": integrate(normals).depth,
        "depth of true normals": integrate(case.normals).depth,
        "plane": np.ones_like(case.depth),
        "half ball": _half_ball(case.inside),
    }
    if case.focal:  # at the distance where a pixel is one unit wide
        surfaces["half ball"] += case.focal
    return {
        name: 100 * _depth_error(depth, case, side) for name, depth in surfaces.items()
    }


def _half_ball(inside: np.ndarray) -> np.ndarray:
    """Depth in pixels of half an ellipsoid over the mask's box."""
    rows, columns = np.nonzero(inside)
    height, width = (1 + np.ptp(places) for places in (rows, columns))
    y = (np.arange(len(inside)) - rows.min() + 0.5) / height * 2 - 1
    x = (np.arange(inside.shape[1]) - columns.min() + 0.5) / width * 2 - 1
    up = np.sqrt(np.maximum(1 - x**2 - y[:, None] ** 2, 0))
    return -up * min(height, width) / 2


def _depth_error(depth: np.ndarray, case: Case, side: int) -> float:
    """The mean distance over the object's longer side, each island placed at best."""
    assert case.depth is not None
    islands, count = scipy.ndimage.label(case.inside)
    off, distance = 0.0, float(np.median(case.depth[case.inside]))
    for index in range(1, count + 1):
        found, truth = depth[islands == index], case.depth[islands == index]
        if case.focal:
            factor = np.median(truth / found)
            off += np.abs(factor * found - truth).sum() / distance * case.focal
        else:
            off += np.abs(found - truth - np.median(found - truth)).sum()
    return float(off / case.inside.sum() / side)


def _angles(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    length = np.maximum(np.linalg.norm(truth, axis=-1), 1e-9)
    return np.degrees(np.arccos(np.clip((found * truth).sum(-1) / length, -1, 1)))


def _psnr(found: np.ndarray, truth: np.ndarray) -> float:
    factor = (found * truth).sum() / np.square(found).sum()
    peak = np.quantile(truth, 0.99)
    return float(-10 * np.log10(np.square(factor * found - truth).mean() / peak**2))


def _means(rows: Sequence[dict[str, float]]) -> dict[str, Any]:
    """Each figure's mean over the objects that have it, and how many they are."""
    names = dict.fromkeys(name for row in rows for name in row)
    found = {name: [row[name] for row in rows if name in row] for name in names}
    means = {name: round(float(np.mean(values)), 2) for name, values in found.items()}
    return {"objects": {name: len(found[name]) for name in names}, **means}


def _confidence(objects: Sequence[Errors]) -> dict[str, Any]:
    """Every object weighs the same."""
    spread, error = (np.concatenate(parts) for parts in zip(*objects, strict=True))
    weight = np.concatenate([np.full(len(o.error), 1 / len(o.error)) for o in objects])
    bins = np.digitize(spread, _EDGES[1:-1])
    table = []
    for index in range(len(_EDGES) - 1):
        there = bins == index
        share = float(weight[there].sum() / weight.sum())
        mean = np.average(error[there], weights=weight[there]) if there.any() else None
        bounds = f"{_EDGES[index]}-{_EDGES[index + 1]}"
        table.append([bounds, mean and round(float(mean), 2), round(share, 3)])

    def left(order: np.ndarray, kept: float) -> float:
        cumulated = np.cumsum(weight[order]) / weight.sum()
        first = order[cumulated <= kept + 1e-9]
        return round(float(np.average(error[first], weights=weight[first])), 2)

    return {
        "objects": len(objects),
        "spread, error, share": table,
        "kept": _KEPT,
        "error left": [left(np.argsort(spread), share) for share in _KEPT],
        "least possible": [left(np.argsort(error), share) for share in _KEPT],
    }


if __name__ == "__main__":
    raise SystemExit(main())
