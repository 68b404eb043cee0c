"""Writes what people look at: tables, sheets, the report, submissions."""

import datetime
import hashlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from unips_jax.baselines.method import Observed
from unips_jax.evaluation.benchmarks import submission_bytes
from unips_jax.evaluation.cells import Table
from unips_jax.evaluation.plan import Plan, subsets_of
from unips_jax.evaluation.protocols import choose_images, show
from unips_jax.evaluation.report import Exhibit, Header, exhibit, report
from unips_jax.evaluation.results import Results
from unips_jax.evaluation.runner import Result
from unips_jax.evaluation.sheets import Panel, sheet
from unips_jax.evaluation.store import Store
from unips_jax.evaluation.summary import TABLES
from unips_jax.evaluation.tables import figures_csv, files_of
from unips_jax.io.claims import slug
from unips_jax.io.door import digest, write_whole
from unips_jax.io.images import encode_image
from unips_jax.io.results import appearing_at_once, filling
from unips_jax.provenance import code_hash
from unips_jax.version import __version__

# What `write_inputs` writes.
_INPUTS = ("L_*.png", "mask.png", "light_directions.txt", "light_intensities.txt")


def write_tables(store: Store, tables: Sequence[Table]) -> Path:
    """Writes the tables in all formats; removes those that only earlier runs had."""
    folder = store.root / "tables"
    with store.claim("publish", wait=True):
        files = files_of(tables)
        with filling(folder) as new:
            for name, data in files.items():
                write_whole(new / name, data)
        for name in {f"{table}.csv" for table in TABLES} - set(files):
            (folder / name).unlink(missing_ok=True)
    return folder


def write_figures(store: Store, results: Results) -> Path:
    """Writes every number of the run as one CSV; returns its path."""
    path = store.root / "tables" / "figures.csv"
    with store.claim("publish", wait=True):
        write_whole(path, figures_csv(results))
    return path


def make_exhibits(plan: Plan, results: Results, store: Store) -> Iterator[Exhibit]:
    """Draws every object's sheet into `sheets/`, unless it is there, for the report."""
    folder = store.root / "sheets"
    for index, entry in enumerate(plan.benchmark.entries):
        own = [
            result
            for label in results.labels
            for result in results.each(label, results.main_count, plan.seeds[0])
            if result.entry == entry.name
        ]
        total = len(entry.images)
        count = total if results.main_count is None else results.main_count
        case = show(
            plan.benchmark[index],
            plan.protocol,
            choose_images(count, total, seed=plan.seeds[0]),
            crop_focal_ratio=plan.benchmark.crop_focal_ratio,
        )
        panels = [_panel(store, result) for result in own]
        caption = _caption(entry.name, own[0])
        names = "\n".join(result.name for result in own)
        of_names = hashlib.blake2b(names.encode(), digest_size=4).hexdigest()
        path = folder / f"{slug(entry.name)}-{of_names}.png"
        with store.claim("publish", wait=True):
            if not path.is_file():
                write_whole(path, sheet(caption, case, panels))
            data = path.read_bytes()
        yield exhibit(entry.name, caption, data, case, panels)


def header_of(plan: Plan, command: str) -> Header:
    """Where a report of this plan comes from; `command` is what was typed."""
    prints = "\n".join(plan.fingerprints)
    of_data = hashlib.blake2b(prints.encode(), digest_size=8).hexdigest()
    keys = {variant.label: variant.key for variant in plan.variants}
    weights = {
        label: key.get("weights") or key.get("options", {}).get("weights", "")
        for label, key in keys.items()
    }
    now = datetime.datetime.now(datetime.UTC)
    return Header(
        date=f"{now:%Y-%m-%d %H:%M} UTC",
        data=f"{plan.benchmark.name} in {plan.benchmark.root.resolve().name}, hash "
        f"{of_data}",
        command=_shortened(command),
        version=f"{__version__}, code {code_hash('evaluation.publish')}",
        weights={label: str(hash_) for label, hash_ in weights.items() if hash_},
    )


def _shortened(command: str) -> str:
    """The command with the home folder as ~, where there is one."""
    home = os.path.expanduser("~")  # Path's raises without one
    if home in ("~", os.sep):
        return command
    return command.replace(home + os.sep, "~" + os.sep)


def write_report(
    store: Store,
    header: Header,
    results: Results,
    tables: Sequence[Table],
    exhibits: Sequence[Exhibit],
) -> Path:
    """Writes the report."""
    path = store.root / "report.html"
    with store.claim("publish", wait=True):
        write_whole(path, report(header, results, tables, exhibits))
    return path


def write_inputs(plan: Plan, folder: Path) -> Iterator[Path]:
    """Writes what methods are given, for programs that cannot be called from here.

    `OBJECT.data/L_001.png` and so on, linear 16-bit photographs; `mask.png`; where the
    lights are known, `light_directions.txt` and `light_intensities.txt`, a line `x y z`
    or `R G B` per photograph. Photographs of floats are scaled together, so that the
    object's brightest value is 65535. Where the run has several subsets of images, a
    folder for each. Yields each object's folder.
    """
    for index, entry in enumerate(plan.benchmark.entries):
        item = plan.benchmark[index]
        for subset, chosen in subsets_of(plan, index):
            ratio = plan.benchmark.crop_focal_ratio
            case = show(item, plan.protocol, chosen, crop_focal_ratio=ratio)
            place = folder if subset.alone else folder / subset.folder
            place /= f"{entry.name.replace('/', '_')}.data"
            with appearing_at_once(place, ours=_INPUTS) as new:
                whole = item.images.dtype.kind != "f"
                _write_observed(new, case.observed, top=1.0 if whole else None)
        yield place


def _write_observed(place: Path, observed: Observed, top: float | None) -> None:
    if top is None:
        top = float(observed.images[:, observed.mask].max(initial=1e-30))
    for i, image in enumerate(observed.images):
        pixels = np.rint(np.clip(image / top, 0, 1) * 65535).astype(np.uint16)
        write_whole(place / f"L_{i + 1:03d}.png", encode_image(".png", pixels))
    mask = np.where(observed.mask, 255, 0).astype(np.uint8)
    write_whole(place / "mask.png", encode_image(".png", mask))
    if observed.lights:
        for name, table in observed.lights._asdict().items():
            text = "".join(" ".join(f"{x:.7g}" for x in row) + "\n" for row in table)
            write_whole(place / f"light_{name}.txt", text.encode())


def write_submissions(store: Store, results: Results) -> Path:
    """Writes DiLiGenT10^2's files, a folder per method, into the folder it returns.

    It is named as the method, with a hash where a folder cannot have that name. Files
    of objects that these results have no more are removed.
    """
    folder = store.root / "submission"
    main = (results.main_count, results.seeds[0])
    with store.claim("publish", wait=True):
        for label in results.labels:
            own = [*results.each(label, *main)]
            if not own:
                continue
            name = slug(label)
            if name != label:  # which others may be too: mpm, and mpm with a dagger
                name += f"-{digest(label)}"
            with appearing_at_once(folder / name, ours=["*.mat"]) as new:
                for result in own:
                    if not result.unsupported:
                        data = submission_bytes(store.normals(result.name))
                        write_whole(new / f"{result.entry}.mat", data)
    return folder


def _panel(store: Store, result: Result) -> Panel:
    mae = result.score.mae if result.score else None
    normals = None if result.unsupported else store.normals(result.name)
    return Panel(result.label, normals, mae, result.reason)


def _caption(name: str, result: Result) -> str:
    words = [name, result.tags.get("material"), result.tags.get("category")]
    parts = list(dict.fromkeys(word for word in words if word))
    subset = "" if result.seed is None else f", seed {result.seed}"
    return " · ".join([*parts, f"{result.images} images{subset}"])
