"""The analogue of the paper's Table 8 on scenes of our own.

    python tools/table8.py OUT

Renders 6 objects under three lightings with 10 images of 256 x 256 each, and compares
UniPS with the paper's competitors, the classical methods and both floors. Started
again, it only does what is left. What differs from the paper: the data (rendered here,
not PS-Wild-Test), the weights of UniPS (ours), and MPM (our reconstruction); the
report's section "What the methods are" says so again. GCNet takes part at half the
width with weights of ours (`tools/train_gcnet.py`), and with the authors' where they
are given, converted.
"""

import argparse
from pathlib import Path

from unips_jax.cli import eval as evaluation
from unips_jax.cli import render

METHODS = "unips gcnet-small mpm mpm:sign=oracle variational classical".split()


def main() -> None:
    """Parses the command line and runs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, metavar="OUT")
    parser.add_argument("--weights", default="tiny", help="of UniPS (tiny)")
    parser.add_argument("--gcnet", metavar="FILE", help="the authors' GCNet")
    parser.add_argument("--objects", type=int, default=6, help="(6)")
    arguments = parser.parse_args()
    scenes = arguments.out / "scenes"
    size = ("--images", "10", "--size", "256", "--seed", "8")
    made = ("-o", str(scenes), "--objects", str(arguments.objects), *size)
    gcnet = (f"gcnet:weights={arguments.gcnet},normals=woodham",)
    methods = (*METHODS, *(gcnet if arguments.gcnet else ()))
    compared = (
        *("--benchmark", "ps-wild", "--root", str(scenes)),
        *("--workdir", str(arguments.out / "evaluation")),
        *("--weights", arguments.weights, "-m", *methods),
    )
    raise SystemExit(render.main(made) or evaluation.main(compared))


if __name__ == "__main__":
    main()
