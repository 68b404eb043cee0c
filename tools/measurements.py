"""What `tools/results.py` can measure: each figure's command, and how it is read."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import readings
from readings import Setting, Table


class Measurement(NamedTuple):
    """A measurement.

    Attributes:
        title: one line.
        about: what the data are.
        line: the command.
        read: runs it and reads what came out.
    """

    title: str
    about: str
    line: str
    read: Callable[[Setting, str], Table]


_OTHER_MAPS = (
    "python tools/maps.py --scenes 10 --diligent shared/diligent_dev --ps-wild "
    "ps-wild-mini --weights tiny"
)
_TRUST = (
    "python tools/maps.py --scenes 5 --diligent shared/diligent_dev --ps-wild "
    "ps-wild-mini --weights tiny --confidence"
)
MEASUREMENTS = {
    "held-out": Measurement(
        "Held-out scenes, by number of images",
        "256 scenes of the generator that trains, from keys that training never uses, "
        "128 x 128 pixels; a column per number of images.",
        "unips validate --weights tiny --scenes 256 --images 1 2 4 8 --json",
        readings.validate,
    ),
    "more-images": Measurement(
        "More images",
        "The first 24 of these scenes.",
        "unips validate --weights tiny --scenes 24 --images 8 16 32 --json",
        readings.validate,
    ),
    "uniform": Measurement(
        "Uniform material under directional light",
        "64 such scenes, 8 images.",
        "unips validate --weights tiny --scenes 64 --images 8 --light directional "
        "--material uniform --json",
        readings.validate,
    ),
    "demo": Measurement(
        "The bundled object",
        "Rendered with Blender Cycles, 8 images of 192 x 192.",
        "unips demo --weights tiny -o out/demo",
        readings.demo,
    ),
    "ps-wild-mini": Measurement(
        "ps-wild-mini",
        "Twelve objects under three lightings, rendered with Blender Cycles, 10 images "
        "each (`unips render --engine cycles --preset ps-wild-mini -o ps-wild-mini`): "
        "shapes and materials are made by other code than the training scenes', "
        "environments are Blender's. `sbl`, sparse Bayesian, knows the lights.",
        "unips eval --benchmark ps-wild --root ps-wild-mini --workdir out/ps-wild-mini "
        "--weights tiny -m unips sbl",
        functools.partial(readings.ps_wild, name="ps-wild-mini"),
    ),
    "ps-wild-real": Measurement(
        "ps-wild-real",
        "Ten meshes by others in Blender's photographed environments, under three "
        "lightings, rendered with Blender Cycles, 10 images each (`unips render "
        "--engine cycles --preset ps-wild-real --meshes assets/meshes -o "
        "ps-wild-real`): training sees neither. `sbl` knows the lights.",
        "unips eval --benchmark ps-wild --root ps-wild-real --workdir out/ps-wild-real "
        "--weights tiny -m unips sbl",
        functools.partial(readings.ps_wild, name="ps-wild-real"),
    ),
    "fast": Measurement(
        "What `--fast` costs",
        "The mirrored view at all pixels, and at few; on as many sets of ps-wild-real "
        "as were rendered when it was measured. What it saves: [seconds](#seconds).",
        "unips eval --benchmark ps-wild --root ps-wild-real --workdir out/fast "
        "--weights tiny -m unips unips:fast=true",
        readings.fast,
    ),
    "known-lights": Measurement(
        "What known lights gain",
        "By `--known-lights`: without, directions 20 degrees off, and exact ones. "
        "24 reliefs and plates of ours (`unips render --objects 24 --images 10 --size "
        "192 --shapes relief plate --seed 24 -o reliefs`) and as many sets of "
        "ps-wild-real as were rendered when it was measured, both under lamps alone; "
        "DiLiGenT's objects with 10 photographs.",
        " && ".join(
            f"unips eval --benchmark {data} --workdir out/known/{name} --weights tiny "
            "-m unips unips:lights=20 unips:lights=true"
            for name, data in (
                ("reliefs", "ps-wild --root reliefs/directional"),
                ("ps-wild-real", "ps-wild --root ps-wild-real/directional"),
                (
                    "DiLiGenT",
                    "diligent --root shared/diligent_dev --objects ball cow pot1 "
                    "reading --num-images 10",
                ),
            )
        ),
        readings.known_lights,
    ),
    "table8": Measurement(
        "The paper's Table 8, on our scenes",
        "6 objects under three lightings, 10 images of 256 x 256. The paper's means "
        "are of other data and, for UniPS, other weights. `woodham`, `l1`, `sbl` "
        "and `rpca` know the lights; `mpm` is our reconstruction; †: the truth chose "
        "the signs.",
        "python tools/table8.py out/table8 --weights tiny",
        readings.table8,
    ),
    "diligent": Measurement(
        "Real photographs: four objects of DiLiGenT",
        "10 images, drawn from every third of the benchmark's 96; published scores are "
        "of all 96. `woodham`, least squares, knows the lights.",
        "unips eval --benchmark diligent --root shared/diligent_dev --objects ball cow "
        "pot1 reading --num-images 10 --workdir out/diligent --weights tiny -m unips "
        "woodham",
        readings.diligent,
    ),
    "real": Measurement(
        "Photographs, and masks that miss the object",
        "DiLiGenT's objects with 10 images and with all that are there; PSBox's cat "
        "under known lamps, against least squares with these lamps, since there is no "
        "scanned truth; spheres and DiLiGenT's objects under masks that are some "
        "pixels too small or too large, scored well inside.",
        "python tools/real_sets.py --photographs shared --weights tiny --json",
        readings.real,
    ),
    "lights": Measurement(
        "Where the light comes from",
        "Mean angle between the photographs' directions of light and the truth, in "
        "degrees: by the network's guesses, by least squares on its normals, and of "
        "(0, 0, 1). Thirty scenes of 96 x 96 with 8 photographs, DiLiGenT's objects "
        "and ps-wild-mini with 10. The truth is the lamp's where it gives a quarter of "
        "the light or more, and in ps-wild-mini's mixed light; else the mean's. "
        "Photographs whose mean direction is shorter than 0.2, of light from all "
        "around, are left out.",
        _OTHER_MAPS,
        functools.partial(
            readings.maps,
            UniPS="network",
            least_squares="least squares",
            constant="constant",
        ),
    ),
    "colors": Measurement(
        "Base colour and texture maps",
        "PSNR in decibels, higher is better: base colour of what is no metal, up to "
        "one factor, against the 99th percentile of the truth; with the mean of the "
        "photographs and one colour; texture maps (PTM) against the photographs they "
        "were fitted to. Where there are two numbers of objects, the second is that of "
        "the texture maps.",
        _OTHER_MAPS,
        functools.partial(
            readings.maps,
            base_colour="base colour",
            photographs="mean photograph",
            one_colour="one colour",
            texture_map="texture map",
        ),
    ),
    "depth": Measurement(
        "Depth",
        "Mean distance from the true depth, in percent of the object's longer side, "
        "after the best shift (under a perspective camera, the best factor), of every "
        "island apart; with that of the true normals, a plane and half a ball.",
        _OTHER_MAPS,
        functools.partial(
            readings.maps,
            UniPS="depth",
            true_normals="depth of true normals",
            plane="plane",
            half_ball="half ball",
        ),
    ),
    "confidence": Measurement(
        "What is left of the error where the normals are trusted",
        "Mean angular error, in degrees, of the pixels whose normals spread least over "
        "halves of the photographs (`--confidence`), by how many are kept.",
        _TRUST,
        readings.kept,
    ),
    "spread": Measurement(
        "The error by spread",
        "Mean angular error in degrees, and share of the pixels, by spread in degrees.",
        _TRUST,
        readings.by_spread,
    ),
}
