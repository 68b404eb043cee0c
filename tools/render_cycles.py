"""Sets up Blender's own Python, and renders with it.

    python tools/render_cycles.py --setup .venv-bpy
    UNIPS_BPY_PYTHON=.venv-bpy/bin/python python tools/render_cycles.py -o OUT ...

The first makes a virtual environment with `bpy` (a wheel of 370 MB for Python 3.11,
GPL-3; it wants a NumPy that JAX does not). On Debian it needs the packages libx11-6
libxrender1 libxfixes3 libxi6 libxkbcommon0 libsm6 libgl1. The second is the same as
`unips render --engine cycles -o OUT ...`.
"""

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

from unips_jax.cli import render
from unips_jax.cycles.blender_process import python_in

REQUIREMENTS = ("bpy==4.5.15", "numpy<2")


def set_up(folder: Path, python: str) -> None:
    """Makes the environment and tries it."""
    subprocess.run([python, "-m", "venv", str(folder)], check=True)
    inside = str(python_in(folder))
    subprocess.run([inside, "-m", "pip", "install", *REQUIREMENTS], check=True)
    subprocess.run(
        [inside, "-c", "import bpy; print(bpy.app.version_string)"], check=True
    )
    command = "set" if sys.platform == "win32" else "export"
    print(f"now: {command} UNIPS_BPY_PYTHON={inside}")


def main() -> int:
    """Parses the command line and runs."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        add_help="--setup" in sys.argv or len(sys.argv) == 1,
    )
    parser.add_argument("--setup", type=Path, metavar="DIR")
    parser.add_argument("--python", default="python3.11", help="(python3.11)")
    arguments, rest = parser.parse_known_args()
    if arguments.setup is None:
        return render.main(["--engine", "cycles", *rest])
    if shutil.which(arguments.python) is None:
        print(
            f"error: --python: expected a Python 3.11, found no {arguments.python}; "
            "install it, or say where one is",
            file=sys.stderr,
        )
        return 2
    set_up(arguments.setup, arguments.python)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
