"""Images of normals and materials under new light.

RESULT is a folder of `unips estimate` (its base colour is taken, where it has one), a
normal map or a .npy. OUT receives relit.png (8 bit, sRGB), relit.exr (linear light) and
relight.json; with --turn also turning.mp4, .gif or .webp, in which the light, or the
environment, goes once around. No shadows are cast.

With --lights-from, relit.png and .exr are lit as the first photograph of that result
was, relit-01.png and so on as the others.
"""

import dataclasses
import functools
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from unips_jax.console import command, parse, progress, start_jax
from unips_jax.errors import InputError
from unips_jax.io.color import srgb_encode
from unips_jax.io.door import write_json
from unips_jax.io.images import (
    linear_of,
    read_image_file,
    read_linear,
    require_finite,
    require_size,
    write_exr,
    write_image,
)
from unips_jax.io.normal_maps import print_examined, read_normal_map
from unips_jax.io.normals import NormalMap
from unips_jax.io.record import print_line
from unips_jax.io.results import appearing_at_once, check_target, transfer_of
from unips_jax.pictures.animation import AnimationFormat, write_animation

RECORD = "relight.json"
_BRIGHT = 0.9  # linear value that the brightest half a percent is brought to
_GREY = (0.8, 0.8, 0.8)


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `unips relight`.

    Attributes:
        result: a folder of results, a normal map or a .npy.
        output: folder for the pictures.
        light: direction to a distant light: x right, y up, z to the viewer; by default
            from the upper left, unless there is an environment.
        lights_from: in place of a light, those of another result's photographs, its
            lights.json, or the directions of a list (.lp).
        environment: an equirectangular picture, best .hdr or .exr; its middle is behind
            the object.
        yaw: turn the environment by that many degrees, counter-clockwise from above.
        turn: also write a moving picture.
        frames: of it.
        fps: its frames per second.
        base_color: an image of the normals' size in place of the result's base colour;
            without any the surface is grey.
        roughness: of the whole surface.
        metallic: of the whole surface.
        exposure: this many stops brighter than the image whose brightest half a
            percent is just below white.
        normal_map: green is up (opengl) or down (directx), down and blue away from the
            viewer (opencv), or red to the left (x-left).
        as_stored: take the values as they are: what is certainly wrong with them is not
            mended.
        focal: focal length in pixels; without it the camera is orthographic.
    """

    result: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RESULT")]
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    light: tuple[float, float, float] | None = None
    lights_from: Annotated[Path | None, tyro.conf.arg(metavar="RESULT|FILE.lp")] = None
    environment: Path | None = None
    yaw: float = 0.0
    turn: AnimationFormat | None = None
    frames: int = 48
    fps: float = 24.0
    base_color: Path | None = None
    roughness: float = 0.6
    metallic: float = 0.0
    exposure: float = 0.0
    normal_map: NormalMap = "opengl"
    as_stored: bool = False
    focal: float | None = None


@command
def main(argv: Sequence[str] | None = None) -> None:
    """`unips relight`."""
    options = parse(Options, argv, prog="unips relight", description=__doc__)
    _check(options)
    examined = read_normal_map(
        options.result, options.normal_map, as_stored=options.as_stored
    )
    print_examined(examined)
    normals = examined.normals
    base_color, source = _base_color(options, normals.shape[:2])
    environment, rig = None, None
    if options.environment is not None:
        environment = read_linear(options.environment)
    if options.lights_from is not None:
        rig = _rig(options.lights_from)
    start_jax()
    if rig is None:
        render = _renderer(options, normals, base_color, environment)
    else:
        render = _rig_renderer(options, normals, base_color, rig)
    with appearing_at_once(options.output, record=RECORD) as place:
        image = render(0.0)
        gain = _gain(image, normals) * 2**options.exposure
        write_image(place / "relit.png", _encoded(image * gain))
        for index in range(1, 0 if rig is None else len(rig[0])):
            lit = _encoded(render(index) * gain)
            write_image(place / f"relit-{index:02}.png", lit)
        write_exr(place / "relit.exr", {"RGB": image * np.float32(gain)})
        if options.turn is not None:
            path = place / f"turning.{options.turn}"
            write_animation(path, _frames(options, render, gain), fps=options.fps)
        names = sorted(file.name for file in place.iterdir())
        record = {
            "normals": str(options.result),
            "mended": examined.mended,
            "warnings": examined.doubts,
            "base_color": source,
            "light": None
            if options.environment or options.lights_from
            else _direction(options),
            "lights_from": str(options.lights_from) if options.lights_from else None,
            "environment": str(options.environment) if options.environment else None,
            "gain": gain,
            "options": {
                name: getattr(options, name)
                for name in ("yaw", "roughness", "metallic", "exposure", "focal")
            },
            "files": names,
        }
        write_json(place / RECORD, record, indent=2)
    print_line("surface", f"base colour: {source}")
    print_line("wrote", f"{options.output}/: {', '.join([*names, RECORD])}")


def _check(options: Options) -> None:
    given = [
        f"--{name.replace('_', '-')}"
        for name in ("light", "lights_from", "environment")
        if getattr(options, name) is not None
    ]
    if len(given) > 1:
        raise InputError(
            f"{given[0]}: expected one kind of light, got {given[1]} too; leave one out"
        )
    if options.lights_from is not None and options.turn is not None:
        raise InputError(
            "--turn: expected a light that can go around, got --lights-from; leave one "
            "out"
        )
    for name, default, used, needs in (
        ("yaw", Options.yaw, options.environment, "--environment"),
        ("frames", Options.frames, options.turn, "--turn"),
        ("fps", Options.fps, options.turn, "--turn"),
    ):
        if getattr(options, name) != default and used is None:
            raise InputError(
                f"--{name}: expected something to use it for, got none; add {needs}"
            )
    if options.light is not None:
        length = math.hypot(*options.light)
        if not (math.isfinite(length) and length > 0):
            raise InputError(
                f"--light: expected a direction, not 0, got {options.light}"
            )
    for name, low, high in (
        ("roughness", 0.03, 1.0),
        ("metallic", 0.0, 1.0),
        ("frames", 2, 10000),
        ("fps", 0.1, 1000),
        ("exposure", -20, 20),
    ):
        value = getattr(options, name)
        if not low <= value <= high:
            raise InputError(f"--{name}: expected {low} to {high}, got {value}")
    if options.focal is not None and not 0 < options.focal < math.inf:
        raise InputError(f"--focal: expected pixels above 0, got {options.focal}")
    if not math.isfinite(options.yaw):
        raise InputError(f"--yaw: expected degrees, got {options.yaw}")
    check_target(options.output, options.result, record=RECORD)


def _direction(options: Options) -> tuple[float, float, float]:
    return options.light or (-1.0, 1.0, 1.5)


def _base_color(options: Options, size: tuple[int, int]) -> tuple[np.ndarray, str]:
    """The base colour, and in words where it is from."""
    path = options.base_color
    if path is None:
        path = options.result / "base_color.exr"
        if not path.is_file():
            return np.array(_GREY, np.float32), "grey, none given"
    file = read_image_file(path)
    require_finite(path, file.pixels)
    color = linear_of(file, transfer_of(file))
    require_size(path, color.shape[:2], size)
    return np.clip(color, 0, 1), str(path)


def _renderer(
    options: Options,
    normals: np.ndarray,
    base_color: np.ndarray,
    environment: np.ndarray | None,
) -> Callable[[float], np.ndarray]:
    """The image as a function of how far the light has gone around, in degrees."""
    import jax
    import jax.numpy as jnp

    from unips_jax.lighting.environment import turned
    from unips_jax.lighting.relight import DistantLights, Materials, relight

    x, y, z = _direction(options)

    @jax.jit
    def render(normals, base_color, environment, degrees):
        materials = Materials(base_color, options.roughness, options.metallic)
        show = functools.partial(relight, normals, materials, focal=options.focal)
        if environment is not None:
            return show(environment=turned(environment, options.yaw + degrees))
        angle = jnp.deg2rad(degrees)
        cos, sin = jnp.cos(angle), jnp.sin(angle)
        light = jnp.stack([x * cos - y * sin, x * sin + y * cos, jnp.full((), z)])
        light = light / jnp.linalg.norm(light)
        return show(DistantLights(light[None], jnp.full((1, 3), jnp.pi)))

    return lambda degrees: np.asarray(
        render(normals, base_color, environment, np.float32(degrees))
    )


def _rig(source: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each photograph's light: direction, colour `[N, 3]`; harmonics of the rest."""
    from unips_jax.lighting.rig import read_rig

    found = read_rig(source)
    if isinstance(found, np.ndarray):  # lamps alone
        return found, np.full_like(found, math.pi), np.zeros((len(found), 9, 3))
    return found.directions, found.colors, found.surroundings


def _rig_renderer(
    options: Options,
    normals: np.ndarray,
    base_color: np.ndarray,
    rig: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> Callable[[float], np.ndarray]:
    """The image as a function of the light's number."""
    import jax

    from unips_jax.lighting.relight import DistantLights, Materials, relight

    @jax.jit
    def render(normals, base_color, direction, color, around):
        materials = Materials(base_color, options.roughness, options.metallic)
        lamp = DistantLights(direction[None], color[None])
        return relight(normals, materials, lamp, around, focal=options.focal)

    return lambda index: np.asarray(
        render(normals, base_color, *(np.float32(x[int(index)]) for x in rig))
    )


def _frames(
    options: Options, render: Callable[[float], np.ndarray], gain: float
) -> Iterator[np.ndarray]:
    with progress("relighting") as report:
        for index in range(options.frames):
            yield _encoded(render(360 * index / options.frames) * gain)
            report(index + 1, options.frames)


def _gain(image: np.ndarray, normals: np.ndarray) -> float:
    values = image[(normals != 0).any(-1)]
    if not values.size:
        raise InputError(
            "expected normals that are not 0 somewhere, got none; give others"
        )
    return _BRIGHT / max(float(np.quantile(values, 0.995)), 1e-6)


def _encoded(image: np.ndarray) -> np.ndarray:
    return np.round(255 * srgb_encode(image)).astype(np.uint8)


if __name__ == "__main__":
    sys.exit(main())
