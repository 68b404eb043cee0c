"""How far what a network says beside the normals can be trusted, on held-out scenes.

Everything stands beside a floor that says nothing of the pixel: pixels kept at random,
one colour for all, the mean photograph, one value.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from unips_jax.console import track
from unips_jax.estimation.pure import estimate_maps
from unips_jax.metrics import angular_error_deg
from unips_jax.models.config import ModelConfig
from unips_jax.scenes.config import SceneConfig
from unips_jax.training.validation import held_out_scenes

# Said errors in degrees between which the true ones are looked up.
EDGES = (0.0, 5.0, 10.0, 20.0, 40.0, 180.0)
# Shares of the pixels that are kept, the most certain ones.
KEPT = (1.0, 0.75, 0.5, 0.25)
# A grey of medium roughness that is no metal.
_ROUGHNESS, _METALLIC = 0.5, 0.0


def color_psnr(estimated: np.ndarray, true: np.ndarray) -> float:
    """Peak signal-to-noise ratio of colours up to one scale, in dB.

    Args:
        estimated: `[P, 3]`, linear; the scale that fits best is taken out.
        true: `[P, 3]`, linear, in [0, 1].
    """
    power = float(np.sum(estimated * estimated))
    scale = float(np.sum(estimated * true)) / power if power > 0 else 0.0
    squared = float(np.mean((scale * estimated - true) ** 2))
    return float(-10 * np.log10(max(squared, 1e-10)))


def sparsification(said: np.ndarray, errors: np.ndarray) -> dict[str, float]:
    """Mean errors of what is kept, by what was said and by the truth.

    Args:
        said: `[P]`, errors that were said.
        errors: `[P]`, true ones.

    Returns:
        "kept 50%" and so on: of the pixels with the least said errors; "best 50%": of
        those with the least true ones, which is as good as it can be.
    """
    by_said, by_truth = errors[np.argsort(said, kind="stable")], np.sort(errors)
    found = {}
    for share in KEPT:
        count = max(1, round(share * errors.size))
        found[f"kept {share:.0%}"] = float(np.mean(by_said[:count]))
        found[f"best {share:.0%}"] = float(np.mean(by_truth[:count]))
    return found


def calibration(said: np.ndarray, errors: np.ndarray) -> dict[str, list[float]]:
    """What became of what was said; one row for each pair of `EDGES`.

    Args:
        said: `[P]`, degrees below which nine errors in ten are to be.
        errors: `[P]`, true ones.

    Returns:
        "pixels": their share in percent; "right": the percentage of them whose error
        is at most what was said; "ninth": the error below which nine in ten are. Then
        all pixels, last.
    """
    rows: dict[str, list[float]] = {"pixels": [], "right": [], "ninth": []}
    bins = [(said >= a) & (said < b) for a, b in zip(EDGES, EDGES[1:], strict=False)]
    for inside in (*bins, np.ones(said.shape, bool)):
        some = bool(np.any(inside))
        right = np.mean(errors[inside] <= said[inside]) if some else np.nan
        rows["pixels"].append(100 * float(np.mean(inside)))
        rows["right"].append(100 * float(right))
        ninth = np.quantile(errors[inside], 0.9) if some else np.nan
        rows["ninth"].append(float(ninth))
    return rows


def score_maps(
    params: Any,
    model: ModelConfig,
    scenes: SceneConfig,
    *,
    count: int,
    num_images: int,
    size: int,
) -> dict[str, Any]:
    """Scores the maps of a network with heads on held-out scenes.

    Args:
        params: the network's parameters.
        model: its configuration.
        scenes: the distribution of scenes.
        count: how many scenes.
        num_images: images of each.
        size: side of the images in pixels.

    Returns:
        "calibration" and "sparsification", over the pixels of all scenes;
        "base_color", PSNR in dB, "roughness" and "metallic", mean absolute errors:
        means over scenes, each of the network ("maps") and of floors.
    """
    said, errors, figures = [], [], []
    held_out = held_out_scenes(scenes, count=count, num_images=num_images, size=size)
    for scene in track(held_out, f"{num_images} images", total=count):
        mask = np.asarray(scene.mask)
        maps = estimate_maps(params, scene.images, scene.mask, config=model)
        error = angular_error_deg(maps.normals, scene.normals)
        said.append(np.asarray(maps.error)[mask])
        errors.append(np.asarray(error)[mask])
        figures.append(_materials(scene, maps, mask))
    means = {
        name: {
            who: float(np.mean([each[name][who] for each in figures]))
            for who in figures[0][name]
        }
        for name in figures[0]
    }
    all_said, all_errors = np.concatenate(said), np.concatenate(errors)
    return {
        "calibration": calibration(all_said, all_errors),
        "sparsification": sparsification(all_said, all_errors),
        **means,
    }


def _materials(scene: Any, maps: Any, mask: np.ndarray) -> dict[str, dict[str, float]]:
    """Figures of one scene: of the maps, and of what says nothing of the pixel."""
    true = np.asarray(scene.base_color)[mask]
    light = scene.images / jnp.mean(scene.images, axis=(1, 2, 3), keepdims=True)
    shown = np.asarray(jnp.mean(light, axis=0))[mask]

    def off(name: str, value: Any) -> float:
        return float(np.mean(np.abs(np.asarray(getattr(scene, name))[mask] - value)))

    return {
        "base_color": {
            "maps": color_psnr(np.asarray(maps.base_color)[mask], true),
            "mean photograph": color_psnr(shown, true),
            "one grey": color_psnr(np.ones_like(true), true),
        },
        "roughness": {
            "maps": off("roughness", np.asarray(maps.roughness)[mask]),
            f"always {_ROUGHNESS}": off("roughness", _ROUGHNESS),
        },
        "metallic": {
            "maps": off("metallic", np.asarray(maps.metallic)[mask]),
            f"always {_METALLIC}": off("metallic", _METALLIC),
        },
    }
