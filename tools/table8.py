"""The analogue of the paper's Table 8 on scenes of our own.

    python tools/table8.py OUT

Renders 6 objects under three lightings with 10 images of 256 x 256 each, and compares
UniPS with the paper's competitors, the classical methods and both floors. Started
again, it only does what is left. What differs from the paper: the data (rendered here,
not PS-Wild-Test), the weights of UniPS (ours), and MPM (our reconstruction); the
report's section "What the methods are" says so again. GCNet takes part where its
weights are given: the authors', converted, or those of `tools/train_gcnet.py` (with
`--gcnet-side 64`).
"""

import argparse
from pathlib import Path

from unips_jax.cli import evaluate as evaluation
from unips_jax.cli import render

METHODS = "unips mpm mpm:sign=oracle variational classical".split()


def main() -> None:
    """Parses the command line and runs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, metavar="OUT")
    parser.add_argument("--weights", default="tiny", help="of UniPS (tiny)")
    parser.add_argument("--gcnet", metavar="FILE", help="weights of GCNet")
    parser.add_argument("--gcnet-side", type=int, default=128, help="they see (128)")
    parser.add_argument("--objects", type=int, default=6, help="(6)")
    arguments = parser.parse_args()
    scenes = arguments.out / "scenes"
    size = ("--images", "10", "--size", "256", "--seed", "8")
    made = ("-o", str(scenes), "--objects", str(arguments.objects), *size)
    methods = list(METHODS)
    if arguments.gcnet:
        options = f"weights={arguments.gcnet},normals=woodham"
        methods.append(f"gcnet:{options},side={arguments.gcnet_side}")
    data = ["--benchmark", "ps-wild", "--root", str(scenes)]
    work = ["--workdir", str(arguments.out / "evaluation")]
    compared = [*data, *work, "--weights", arguments.weights, "-m", *methods]
    raise SystemExit(render.main(made) or evaluation.main(compared))


if __name__ == "__main__":
    main()
