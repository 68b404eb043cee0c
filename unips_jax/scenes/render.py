"""Scenes: a geometry shaded under drawn materials and lights, and recorded."""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from unips_jax.scenes.backdrop import above
from unips_jax.scenes.config import MATERIALS, SceneConfig
from unips_jax.scenes.draws import Draws
from unips_jax.scenes.geometry import Geometry, render_geometry
from unips_jax.scenes.incident import IncidentLight, incident_light
from unips_jax.scenes.lamps import draw_lights, draw_sides
from unips_jax.scenes.materials import draw_surface, paint, spot_metal
from unips_jax.scenes.noise import normalize
from unips_jax.scenes.rims import extend
from unips_jax.scenes.sensor import record
from unips_jax.scenes.shading import light_means, radiance, split
from unips_jax.scenes.tracing import object_point


class Scene(NamedTuple):
    """One object under N lights.

    With `jax_enable_x64` all is float64, and a seed gives other scenes.
    """

    # `[N, H, W, 3]` float32 in [0, 1] as the camera recorded them, linear or not, zero
    # outside the mask
    images: Array
    mask: Array  # `[H, W]` bool
    # `[H, W, 3]` float32, x right, y up, z to the viewer, unit inside the mask, zero
    # outside. Where the mask is larger than the object (`SceneConfig.rim_rate`) they
    # continue those of its border.
    normals: Array
    light_kind: Array  # index into `LIGHT_KINDS`
    shape_kind: Array  # index into `SHAPE_NAMES`
    material: Array  # index into `MATERIALS`
    focal: Array  # 35 mm equivalent in mm; 0 for orthographic cameras
    light_directions: Array  # `[N, 3]`, unit, of directional scenes, else zero
    # `[N, 3]`, of the same; exposure and white balance included
    light_intensities: Array
    # `[N, 3]`, the mean direction of each image's light at the object's centre,
    # weighted by power: 1 long for a single light, 0 for light that comes equally from
    # everywhere
    light_means: Array
    # `[H, W, 3]`, linear, in [0, 1]; of metals their reflectance. This and the next two
    # are continued beyond the object as the normals are.
    base_color: Array
    roughness: Array  # `[H, W]`, in [0, 1], perceptual
    metallic: Array  # `[H, W]`, in [0, 1]
    # the light of each image; None unless it was asked for
    incident: IncidentLight | None = None


def shade(
    key: Array,
    geometry: Geometry,
    *,
    num_images: int,
    config: SceneConfig | None = None,
    light_kind: Array | int | None = None,
    material: Array | int | None = None,
    incident: bool = False,
) -> Scene:
    """Draws materials, lights and a camera response for a geometry, again and again."""
    config = config or SceneConfig()
    key_kind, key_surface, key_lights, key_sensor = jax.random.split(key, 4)
    draws = Draws(key_kind, 8)
    light = draws.choice(config.light_weights)
    light = light if light_kind is None else jnp.int32(light_kind)
    matter = draws.choice(config.material_weights)
    matter = matter if material is None else jnp.int32(material)
    shape = geometry.shape
    local = object_point(shape, geometry.to_object, split(geometry.positions))
    inverse = 1 / shape.radius
    local = (local[0] * inverse, local[1] * inverse, local[2] * inverse)
    surface = draw_surface(key_surface, matter, local, geometry.height.reshape(-1))
    if config.paint_rate:
        key_paint = jax.random.fold_in(key_surface, 2)
        surface = paint(key_paint, config.paint_rate, surface, local)
    if config.metal_spot_rate:
        key_spots = jax.random.fold_in(key_surface, 3)
        spotted = Draws(jax.random.fold_in(key_spots, 1), 1).chance(
            config.metal_spot_rate
        )
        spotted &= matter == MATERIALS.index("metal")
        surface = spot_metal(key_spots, spotted, surface, local)
    sides = near = None
    if config.bounce_rate:
        draws = Draws(jax.random.fold_in(key_lights, 3), 2)
        near = draws.chance(config.bounce_rate) * draws.log_uniform(0.02, 0.12)
    if config.side_rate:
        sides = draw_sides(Draws(jax.random.fold_in(key_lights, 1), 8), config)
    photographs = None
    if config.photograph_rate:
        draws = Draws(jax.random.fold_in(key_lights, 2), 8)
        photographs = draws, config.photograph_rate
    far = None
    if config.far_lamp_rate:
        draws = Draws(jax.random.fold_in(key_lights, 4), 2)
        far = draws.chance(config.far_lamp_rate) * draws.log_uniform(3.0, 15.0)
    draws = Draws(key_lights, 160 + 24 * num_images)
    keys, environment = draw_lights(draws, light, num_images, sides, photographs, far)
    if geometry.backdrop is not None and geometry.ground is not None:
        key_ground = jax.random.fold_in(key_surface, 1)
        other = Draws(key_ground, 1).choice(config.material_weights)
        level = jnp.zeros_like(local[0])
        around = draw_surface(jax.random.fold_in(key_ground, 1), other, local, level)
        ground = geometry.ground.reshape(-1)
        surface = jax.tree.map(lambda a, b: jnp.where(ground, a, b), around, surface)
        keys = keys._replace(vector=above(geometry.backdrop, keys.vector))
    linear = radiance(geometry, surface, keys, environment, config, near)
    linear = linear.reshape(num_images, 3, *geometry.mask.shape)
    images, mask, gain = record(key_sensor, linear, geometry.mask, config)
    normals = jnp.moveaxis(geometry.normals, -1, 0)
    own = [*surface.base_color, surface.roughness, surface.metallic]
    matters = jnp.stack(own).reshape(5, *geometry.mask.shape)
    if config.rim_rate:  # masks may be larger than the object
        beyond = jnp.stack(normalize(tuple(extend(normals, geometry.mask))))
        normals = jnp.where(geometry.mask, normals, beyond)
        matters = jnp.where(geometry.mask, matters, extend(matters, geometry.mask))
    normals, matters = (jnp.moveaxis(x, 0, -1) for x in (normals, matters * mask))
    directional = light == 0
    return Scene(
        images=jnp.moveaxis(images, 1, -1),
        mask=mask,
        normals=normals * mask[..., None],
        light_kind=light,
        shape_kind=shape.kind,
        material=matter,
        focal=geometry.focal,
        light_directions=jnp.where(directional, keys.vector, 0.0),
        light_intensities=jnp.where(directional, keys.color * gain, 0.0),
        light_means=light_means(geometry, keys, environment),
        base_color=matters[..., :3],
        roughness=matters[..., 3],
        metallic=matters[..., 4],
        incident=incident_light(keys, environment, gain, geometry.backdrop)
        if incident
        else None,
    )


def render_scene(
    key: Array,
    *,
    size: int,
    num_images: int,
    config: SceneConfig | None = None,
    light_kind: Array | int | None = None,
    material: Array | int | None = None,
    shape: Array | int | None = None,
    camera: Array | int | None = None,
    meshes: ArrayLike | None = None,
    incident: bool = False,
) -> Scene:
    """Draws a scene: a pure function of the key.

    Args:
        key: a random key.
        size: side of the images in pixels, a multiple of 4; static under jit.
        num_images: N; static under jit.
        config: the distribution of scenes.
        light_kind: index into `unips_jax.scenes.LIGHT_KINDS`: 0 "directional",
            "environment", "mixed", "point", 4 "area"; None: a random one.
        material: index into `MATERIALS`: 0 "fabric", "concrete", "wood", "floor",
            "ground", "metal", "uniform", "dark", "glossy", 9 "painted_metal".
        shape: index into `SHAPE_KINDS`: 0 "blob", "composition", "machine", "lathe",
            "thin", "relief", 6 "plate".
        camera: 0 for an orthographic camera, 1 for a perspective one.
        meshes: from `load_meshes`, where `mesh_rate` is above 0.
        incident: whether `Scene.incident` is worked out; static under jit.

    Returns:
        Images `[N, size, size, 3]`, linear or sRGB as a camera's, mask, true normals
        and what was drawn; see `Scene`.

    Raises:
        ValueError: if `size` is not a multiple of 4, or meshes are missing.
    """
    key_geometry, key_shade = jax.random.split(key)
    # GPUs would round places and colours to 10 bits of mantissa in products.
    with jax.default_matmul_precision("float32"):
        geometry = render_geometry(
            key_geometry,
            size=size,
            config=config,
            shape=shape,
            camera=camera,
            meshes=meshes,
        )
        return shade(
            key_shade,
            geometry,
            num_images=num_images,
            config=config,
            light_kind=light_kind,
            material=material,
            incident=incident,
        )


@functools.partial(
    jax.jit, static_argnames=("size", "num_images", "config", "incident")
)
def render_batch(keys: Array, **options: Any) -> Scene:
    """Scenes of keys `[B]`, compiled; options are those of `render_scene`."""
    config, count = options.get("config") or SceneConfig(), len(keys)
    meshes = round(config.mesh_rate * count)

    def render(keys: Array, **changes: Any) -> Scene:
        return jax.vmap(lambda key: render_scene(key, **options | changes))(keys)

    if not 0 < meshes < count:
        return render(keys)
    # Apart: in one program every scene would pay for both kinds of shape.
    parts = (
        render(part, config=dataclasses.replace(config, mesh_rate=rate))
        for part, rate in ((keys[:meshes], 1.0), (keys[meshes:], 0.0))
    )
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
