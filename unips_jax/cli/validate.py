"""`unips validate`: scores of weights on held-out scenes, as JSON."""

import argparse
import json
from collections.abc import Sequence

from unips_jax.console import command, keep_compiled
from unips_jax.errors import InputError
from unips_jax.scenes import LIGHT_KINDS, MATERIALS, SHAPE_KINDS, SceneConfig
from unips_jax.training.validation import validate
from unips_jax.weights import load_weights


@command
def main(argv: Sequence[str] | None = None) -> None:
    """Prints the scores of weights as JSON, a line per number of images."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--weights", default="tiny", help="shipped name or file")
    parser.add_argument("--scenes", type=int, default=256, help="held-out scenes")
    parser.add_argument("--images", type=int, nargs="+", default=[8])
    parser.add_argument("--size", type=int, default=128, help="pixels")
    kinds = {"light_kind": LIGHT_KINDS, "material": MATERIALS, "shape": SHAPE_KINDS}
    for name, choices in kinds.items():
        option = f"--{name.removesuffix('_kind')}"
        parser.add_argument(option, dest=name, choices=choices, help="of all scenes")
    arguments = parser.parse_args(argv)
    if arguments.size <= 0 or arguments.size % 4:
        raise InputError(f"--size: expected a multiple of 4, got {arguments.size}")
    least = min(arguments.scenes, *arguments.images)
    if least < 1:
        raise InputError(f"--scenes, --images: expected at least 1, got {least}")
    keep_compiled()
    model, params = load_weights(arguments.weights)
    chosen = {name: getattr(arguments, name) for name in kinds}
    scene_options = {
        name: kinds[name].index(kind) for name, kind in chosen.items() if kind
    }
    for num_images in arguments.images:
        scores = validate(
            params,
            model,
            SceneConfig(),
            count=arguments.scenes,
            num_images=num_images,
            size=arguments.size,
            description=f"{num_images} images",
            **scene_options,
        )
        rounded = {name: round(score, 2) for name, score in scores.items()}
        print(json.dumps({"images": num_images, **rounded}))
