"""PS-Wild-like sets rendered with Blender Cycles.

Follows the paper (UniPS, CVPR 2022, Sec. 5): one object, one material and one
environment per scene; rotations redrawn until the normals' entropy exceeds 4 bits; the
outline reaches the frame; Principled BSDF; path tracing with up to 10 bounces and 256
samples, no tone mapping; 16-bit linear images. The presets ps-wild-mini and -real have
smaller images and fewer samples. Stop it whenever you like: started again, or several
times at once, it only does what is left. The meshes, materials, environments and
manifest of a set must stay the same.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from unips_jax.cli.cluster import RayOptions, spread
from unips_jax.console import one_of, parse
from unips_jax.cycles.command import PRESETS, plan, render
from unips_jax.cycles.lighting import LIGHTINGS


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `unips render --engine cycles`; what is not given is the preset's.

    Attributes:
        output: the set's folder.
        engine: what renders.
        preset: train and test follow the paper.
        objects: how many; 6, or all of the manifest, if not given.
        images: per object and lighting.
        lightings: of every object; all but near.
        size: side of the images in pixels; 512 if not given.
        samples: paths per pixel; 256 if not given.
        denoise: the images, which is not done if not given.
        perspective: share of such cameras, the rest are orthographic; 0.5 if not given.
        seed: of objects, materials and lights; 0 if not given.
        meshes: folder of meshes.
        materials: folder of texture sets, one folder each.
        environments: folder of .hdr and .exr, or 'blender' for its own.
        manifest: CSV with object, material, category and perhaps lighting.
        threads: of the renderer; 0 for all cores.
        sheet: also a picture of the whole set.
        where: where objects are rendered.
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")]
    engine: Literal["cycles"] = "cycles"
    preset: Annotated[str, one_of(sorted(PRESETS))] = "test"
    objects: int | None = None
    images: int | None = None
    lightings: Annotated[tuple[str, ...], one_of(LIGHTINGS, several=True)] = ()
    size: int | None = None
    samples: int | None = None
    denoise: bool | None = None
    perspective: float | None = None
    seed: int | None = None
    meshes: Path | None = None
    materials: Path | None = None
    environments: Annotated[str | None, tyro.conf.arg(metavar="DIR|blender")] = None
    manifest: Path | None = None
    threads: int = 0
    sheet: Path | None = None
    where: Annotated[RayOptions, tyro.conf.arg(name="")] = RayOptions()


def run(argv: Sequence[str] | None = None) -> None:
    """`unips render --engine cycles`."""
    options = parse(
        Options,
        argv,
        prog="unips render --engine cycles",
        description=__doc__,
        negatable=True,
    )
    options.where.check()
    given = dataclasses.asdict(options) | {"lightings": options.lightings or None}
    del given["engine"], given["where"]
    if options.where.ray:
        place = {name: given[name] for name in ("output", "sheet")}
        asked = {name: value for name, value in given.items() if name not in place}
        names = [job.name for job in plan(**asked).jobs]
        pieces = [(name, given | {"sheet": None, "only": name}) for name in names]
        spread(_render_one, pieces, options.where, "rendering")
    render(**given)  # what is left, and the sheet


def _render_one(given: dict[str, Any]) -> None:
    """One object, in a process of its own."""
    render(**given)
