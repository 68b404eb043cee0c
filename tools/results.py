"""The results page and README's figures, from one file of figures per weights.

    python tools/results.py                     # writes docs/results.md and README
    python tools/results.py --measure           # measures all that can be, then writes
    python tools/results.py --measure held-out demo --weights runs/tiny/last.safetensors

Figures are kept in `docs/results/HASH.json`, by the hash of the weights that they were
measured with, each with its command and date; `docs/results/speed.jsonl` holds what
`tools/benchmark.py` printed, with its arguments and the date. Measuring replaces the
figures of what is named; what needs data that are not there is left out, with a line.
Evaluations are kept in `--workdir` and not done twice.
"""

import argparse
import datetime
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from measurements import MEASUREMENTS
from readings import ROOT, Setting

from unips_jax.console import command
from unips_jax.errors import InputError
from unips_jax.io.door import write_whole
from unips_jax.weights import weights_path, weights_record

Figures = dict[str, Any]

FOLDER = ROOT / "docs" / "results"
PAGE = ROOT / "docs" / "results.md"
README = ROOT / "README.md"
MARKS = ("<!-- figures: tools/results.py -->\n", "<!-- end of figures -->\n")

# README's rows: title, number of images, measurement and its columns.
README_ROWS = (
    ("Photographs: four objects of DiLiGenT", 10, "diligent", ("mean",)),
    (
        "Twelve objects rendered with Cycles: lamp / surroundings / both",
        10,
        "ps-wild-mini",
        ("directional", "environment", "mixed"),
    ),
    (
        "Ten meshes by others, also with Cycles, in photographed environments",
        10,
        "ps-wild-real",
        ("directional", "environment", "mixed"),
    ),
    ("`unips demo`, one more", 8, "demo", ("8",)),
    ("256 held-out scenes, all lights and materials", 8, "held-out", ("8",)),
    ("The same, from one image", 1, "held-out", ("1",)),
)
# What is shown of other weights: title, measurement and its column.
HEADLINES = (
    ("held-out, 1 image", "held-out", "1"),
    ("8 images", "held-out", "8"),
    ("ps-wild-mini", "ps-wild-mini", "mean"),
    ("Table 8's scenes", "table8", "mean"),
    ("DiLiGenT", "diligent", "mean"),
    ("demo", "demo", "8"),
)

HEAD = """# Results

Written by `python tools/results.py` from the files in `docs/results`, not by hand.
Mean angular errors in degrees over an object's pixels, then over objects: lower is
better. `UniPS` are the shipped weights, of a network of our own; the paper's is named
so. A constant normal towards the viewer is the floor; a result near it means
that something is broken. `shared` are photographs that are not published with this
project; `shared/diligent_dev` has every third photograph of four objects of DiLiGenT.
"""
SECONDS = """
## Seconds

What a user waits for: whole processes, the first with an empty cache (cold), the next
with what it kept (warm), whose memory is the last column. Of 640 x 640 pixels 74
thousand are masked. Below, how `estimate_photographs` alone grows, once compiled, with
the number of images and with their side; 55 % of the pixels are masked.

"""
SPEED = """
## Speed and memory

Seconds say little on shared machines. So the network's operations per second are given
as a share of what plain float32 matrix products reached in the same run (GFLOP/s); 1
would be as fast as they are. PyTorch: the share of the paper's network, written plainly
in PyTorch, timed in turn with ours in one run.

"""


def markdown(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A table; numbers have one digit after the point, a dash stands for nothing."""

    def text(cell: Any) -> str:
        shown = f"{cell:.1f}" if isinstance(cell, float) else cell
        return "–" if cell is None else str(shown)

    lines = [columns, ["---", *["---:"] * (len(columns) - 1)], *rows]
    return "".join(f"| {' | '.join(map(text, line))} |\n" for line in lines)


def read_figures(name: str) -> Figures:
    """The figures of weights, by the first eight digits of their hash.

    Raises:
        InputError: if there are none.
    """
    path = FOLDER / f"{name}.json"
    if path.is_file():
        return json.loads(path.read_text())
    raise InputError(
        f"{path}: expected the figures of the weights with that hash, found nothing; "
        "run tools/results.py --measure, or rename the file of weights that differ "
        'from them in nothing else, and its "hash"'
    )


def figure(figures: Figures, name: str, row: str, column: str) -> Any:
    """A cell of a measurement; None if it was not measured."""
    found = figures["measurements"].get(name)
    cells = {cells[0]: cells for cells in found["rows"]} if found else {}
    if row not in cells or column not in found["columns"]:
        return None
    return cells[row][found["columns"].index(column)]


def page(shipped: str) -> str:
    """The results page.

    Args:
        shipped: the first eight digits of the shipped weights' hash.
    """
    own = read_figures(shipped)
    parts = [HEAD, f"\n## The shipped weights, hash {shipped}\n\n"]
    parts.append(f"{own['steps']:,} steps{own.get('about', '')}.\n")
    for name, measurement in MEASUREMENTS.items():
        if found := own["measurements"].get(name):
            note = f" {found['note']}" if "note" in found else ""
            parts += [
                f"\n### {measurement.title}\n\n{measurement.about}\n\n",
                markdown(found["columns"], found["rows"]),
                f"\n`{found['command']}`, {found['date']}.{note}\n",
            ]
    hashes = (path.stem for path in FOLDER.glob("[0-9a-f]" * 8 + ".json"))
    others = [read_figures(name) for name in hashes if name != shipped]
    others.sort(key=lambda other: (other["date"], other["steps"]), reverse=True)
    rows = [
        [other["hash"][:8], other["date"], f"{other['steps']:,}"]
        + [figure(other, name, "UniPS", column) for _, name, column in HEADLINES]
        for other in others
    ]
    parts += [
        "\n## Other weights\n\n",
        "Each measured on the scenes of its time.\n\n",
        markdown(["hash", "date", "steps", *(title for title, *_ in HEADLINES)], rows),
        seconds_table(),
        SPEED,
        speed_table(),
    ]
    return "".join(parts)


def seconds_table() -> str:
    """The tables of `seconds.json`; nothing if it was not measured."""
    path = FOLDER / "seconds.json"
    if not path.is_file():
        return ""
    found = json.loads(path.read_text())
    rows = [
        [row["what"]]
        + [row[run][part] for run in ("cold", "warm") for part in ("cpu", "wall")]
        + [f"{row['warm']['gb']:.1f}"]
        for row in found["rows"]
    ]
    columns = ["", "cold, CPU s", "wall s", "warm, CPU s", "wall s", "GB"]
    parts = [markdown(columns, rows)]
    for key, title in (("images", "images of 128 x 128"), ("side", "side, 4 images")):
        sizes, seconds = zip(*found["growth"][key], strict=True)
        cells = ["CPU s", *(f"{x:.1f}" for x in seconds)]
        parts.append("\n" + markdown([title, *map(str, sizes)], [cells]))
    made = f"{found['processor']}, jax {found['jax']}, {found['date']}"
    made = f"weights {found['hash'][:8]}, {made}"
    return f"{SECONDS}{''.join(parts)}\n`python tools/seconds.py`, {made}.\n"


def speed_table() -> str:
    """The table of `speed.jsonl`."""
    rows = []
    for line in map(json.loads, (FOLDER / "speed.jsonl").read_text().splitlines()):
        part = line.get("step") or line["end_to_end"]
        memory = line.get("step_peak_memory_gb", line.get("peak_memory_gb"))
        rates = line["products_gflop_per_s"]
        shown = f"`tools/benchmark.py {line['arguments']}`".replace(" `", "`")
        share = f"{part['share_of_products']:.2f}"
        between = f"{min(rates):.0f} to {max(rates):.0f}"
        memory = "–" if memory is None else f"{memory:.2f}"
        torch = line.get("torch", {}).get("share_of_products")
        torch = "–" if torch is None else f"{torch:.2f}"
        cells = [shown, line["device"], between, share, torch, memory, line["date"]]
        rows.append(cells)
    names = "command", "device", "GFLOP/s of products", "share", "PyTorch", "GB", "date"
    return markdown(names, rows)


def readme_table(shipped: str) -> str:
    """README's table."""
    own, rows = read_figures(shipped), []
    for title, images, name, shown in README_ROWS:
        if name in own["measurements"]:
            scores, floors = (
                [f"{figure(own, name, row, column):.1f}" for column in shown]
                for row in ("UniPS", "constant normal")
            )
            floors = list(dict.fromkeys(floors))  # one where they are alike
            rows.append([title, images, " / ".join(scores), " / ".join(floors)])
    columns = "Mean angular error, degrees", "images", "shipped", "constant normal"
    return markdown(columns, rows)


def readme(shipped: str, text: str) -> str:
    """README with the table of these weights.

    Args:
        shipped: the first eight digits of the shipped weights' hash.
        text: README as it is.
    """
    before, rest = text.split(MARKS[0])
    _, after = rest.split(MARKS[1])
    return before + MARKS[0] + readme_table(shipped) + MARKS[1] + after


def measure(names: Sequence[str], setting: Setting) -> None:
    """Measures, and writes each figure down when it is there."""
    record = weights_record(setting.weights)
    path = FOLDER / f"{record['hash'][:8]}.json"
    today = datetime.date.today().isoformat()
    for name in names:
        line = MEASUREMENTS[name].line
        try:
            table = MEASUREMENTS[name].read(setting, line)
        except InputError as error:
            print(f"left out {name}: {error}")
            continue
        figures = {"hash": record["hash"], "date": today, "steps": _steps(record)}
        figures = json.loads(path.read_text()) if path.is_file() else figures
        figures.setdefault("measurements", {})[name] = {
            "command": line,
            "date": today,
            **table,
        }
        text = json.dumps(figures, indent=1, ensure_ascii=False)
        write_whole(path, f"{text}\n".encode())
        print(f"measured {name}: {path}")


def _steps(record: Mapping[str, Any]) -> int:
    """Steps of training, of a run or of all runs that led to shipped weights."""
    return record.get("step") or sum(record.get("steps", {}).values())


@command
def main(argv: Sequence[str] | None = None) -> None:
    """Measures if asked to, and writes page and README."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--measure", nargs="*", metavar="NAME", help=f"of {', '.join(MEASUREMENTS)}")
    add("--weights", default="tiny", help="shipped name or file (tiny)")
    add("--workdir", type=Path, default=ROOT / "runs" / "results")
    add("--shared", type=Path, default=ROOT.parent / "shared", help="real photographs")
    for name in ("ps-wild-mini", "ps-wild-real", "reliefs"):
        add(f"--{name}", type=Path, default=ROOT / name, metavar="DIR")
    arguments = parser.parse_args(argv)
    if arguments.measure is not None:
        unknown = sorted(set(arguments.measure) - set(MEASUREMENTS))
        if unknown:
            raise InputError(
                f"--measure {' '.join(unknown)}: expected some of "
                f"{', '.join(MEASUREMENTS)}"
            )
        places = {
            "out": arguments.workdir.resolve(),
            "shared": arguments.shared.resolve(),
            "ps-wild-mini": arguments.ps_wild_mini.resolve(),
            "ps-wild-real": arguments.ps_wild_real.resolve(),
            "reliefs": arguments.reliefs.resolve(),
            "tools": ROOT / "tools",
        }
        weights = arguments.weights
        if weights.endswith(".safetensors"):
            weights = str(weights_path(weights).resolve())
        measure(arguments.measure or list(MEASUREMENTS), Setting(weights, places))
    shipped = weights_record("tiny")["hash"][:8]
    write_whole(PAGE, page(shipped).encode())
    write_whole(README, readme(shipped, README.read_text()).encode())
    print(f"wrote {PAGE} and {README}")


if __name__ == "__main__":
    raise SystemExit(main())
