"""Angular errors on held-out scenes, in groups.

The scenes come from keys that training never uses. A constant normal towards the
viewer is scored too: a result near it means that something is broken.
"""

import textwrap
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from unips_jax.console import track
from unips_jax.estimation.pure import estimate_normals
from unips_jax.metrics import angular_error_deg, mean_angular_error_deg
from unips_jax.models.network import UniversalNetwork
from unips_jax.pictures.maps import error_picture, normals_picture, photograph_picture
from unips_jax.scenes import (
    LIGHT_KINDS,
    MATERIALS,
    SHAPE_NAMES,
    Scene,
    SceneConfig,
    load_meshes,
    render_scene,
)
from unips_jax.scenes.draws import seeded
from unips_jax.training.config import Config

# Training keys are folded from small seeds; this one is apart from all of them.
_HELD_OUT_SEED = 0x7E57

_render = jax.jit(render_scene, static_argnames=("size", "num_images", "config"))


def held_out_key(index: int) -> jax.Array:
    """The key of held-out scene number `index`."""
    return jax.random.fold_in(seeded(_HELD_OUT_SEED), index)


def held_out_scenes(
    scenes: SceneConfig, *, count: int, num_images: int, size: int, **scene_options: Any
) -> Iterator[Scene]:
    """Held-out scenes; arguments as in `validate`."""
    meshes = load_meshes(scenes)
    for index in range(count):
        yield _render(
            held_out_key(index),
            size=size,
            num_images=num_images,
            config=scenes,
            meshes=meshes,
            **scene_options,
        )


def estimate_held_out(
    network: UniversalNetwork, scenes: SceneConfig, **options: Any
) -> Iterator[tuple[Scene, jax.Array]]:
    """Held-out scenes and their estimated normals; arguments as in `validate`."""
    for scene in held_out_scenes(scenes, **options):
        yield scene, estimate_normals(network, scene.images, scene.mask)


def validate(
    network: UniversalNetwork,
    scenes: SceneConfig,
    *,
    count: int,
    num_images: int,
    size: int,
    description: str = "validating",
    **scene_options: Any,
) -> dict[str, float]:
    """Mean angular errors on held-out scenes, in degrees.

    "mae" over all scenes, "constant" for a normal towards the viewer, and one per
    group, such as "light/directional". The scenes' objects do not depend on
    `num_images`; options go to `render_scene`, such as `light_kind`.
    """
    errors: dict[str, list[float]] = {}
    held_out = estimate_held_out(
        network, scenes, count=count, num_images=num_images, size=size, **scene_options
    )
    for scene, normals in track(held_out, description, total=count):
        error = float(mean_angular_error_deg(normals, scene.normals, scene.mask))
        constant = mean_angular_error_deg(
            jnp.array([0.0, 0.0, 1.0]), scene.normals, scene.mask
        )
        errors.setdefault("constant", []).append(float(constant))
        for name in ("mae", *_groups(scene)):
            errors.setdefault(name, []).append(error)
    return {name: float(np.mean(values)) for name, values in sorted(errors.items())}


def score_table(scores: dict[str, float]) -> str:
    """The groups' scores as a few lines for a terminal of 100 columns."""
    groups: dict[str, list[tuple[float, str]]] = {}
    for name, score in scores.items():
        if "/" in name:
            group, kind = name.split("/")
            groups.setdefault(group, []).append((score, kind))
    lines = []
    for group, members in groups.items():
        # A no-break space keeps a kind and its score on one line.
        text = ", ".join(f"{kind}\xa0{score:.1f}" for score, kind in sorted(members))
        indent = f"  {group:10}"
        lines += textwrap.wrap(
            text, 100, initial_indent=indent, subsequent_indent=" " * len(indent)
        )
    return "\n".join(lines).replace("\xa0", " ")


def validation_pictures(
    network: UniversalNetwork, config: Config, count: int = 4
) -> dict[str, np.ndarray]:
    """Rows of image, true normals, estimate, errors: `[H, 4 H, 3]` by scenes' names."""
    held_out = estimate_held_out(
        network,
        config.scenes,
        count=count,
        num_images=config.train.validation_images,
        size=config.data.image_size,
    )
    rows = {}
    for index, (scene, normals) in enumerate(held_out):
        mask, true = np.asarray(scene.mask), np.asarray(scene.normals)
        error = np.asarray(angular_error_deg(normals, true))
        tiles = [
            photograph_picture(np.asarray(scene.images[0]), mask),
            normals_picture(true, mask),
            normals_picture(np.asarray(normals), mask),
            error_picture(error, mask),
        ]
        rows[f"validation/scene{index}"] = np.concatenate(tiles, axis=1)
    return rows


def _groups(scene: Scene) -> list[str]:
    camera = "perspective" if scene.focal > 0 else "orthographic"
    return [
        f"light/{LIGHT_KINDS[int(scene.light_kind)]}",
        f"material/{MATERIALS[int(scene.material)]}",
        f"shape/{SHAPE_NAMES[int(scene.shape_kind)]}",
        f"camera/{camera}",
    ]
