"""`unips eval`: any method on any benchmark, resumable, with tables and a report.

Everything is checked before any work starts: the benchmark's layout and files, the
methods, their weights. Results are kept in the work folder object by object; the same
command started again, or beside itself, does only what is left.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from unips_jax.console import command, keep_compiled, track
from unips_jax.errors import InputError
from unips_jax.evaluation import publish, runner, summary
from unips_jax.evaluation.benchmarks import BENCHMARKS, Benchmark, open_benchmark
from unips_jax.evaluation.methods import NAMES, UnipsOptions, load_variants
from unips_jax.evaluation.protocols import Protocol
from unips_jax.evaluation.store import Store
from unips_jax.evaluation.tables import text_of


def _main(argv: Sequence[str] | None = None) -> None:
    arguments = _parser().parse_args(argv)
    workdir = Path(arguments.workdir)
    _check_options(arguments)
    benchmark = open_benchmark(
        arguments.benchmark, arguments.root, objects=arguments.objects
    )
    _check_workdir(workdir, benchmark)
    name: Any = arguments.protocol or benchmark.default_protocol
    protocol = Protocol(name)
    if arguments.crop_size is not None:
        if name == "native":
            raise InputError(
                f"--crop-size {arguments.crop_size}: expected --protocol crop, got "
                "native; change the protocol or leave the size out"
            )
        protocol = Protocol(name, arguments.crop_size)
    if benchmark.name == "diligent102" and protocol.name != "native":
        raise InputError("diligent102: submissions need --protocol native")
    counts = list(dict.fromkeys(arguments.num_images))
    runner.check_counts(benchmark, counts)
    keep_compiled()
    options = UnipsOptions(
        arguments.weights or ["tiny"],
        arguments.canonical_size,
        arguments.uniform_contexts,
    )
    variants = load_variants(arguments.method, options)
    fingerprints = list(
        track(runner.check_data(benchmark), "checking data", total=len(benchmark))
    )
    plan = runner.Plan(
        benchmark, variants, protocol, counts, arguments.seed, fingerprints
    )
    _evaluate(plan, Store(workdir), pictures=not arguments.no_pictures)


def _check_options(arguments: argparse.Namespace) -> None:
    if arguments.seed < 0:
        raise InputError(f"--seed: expected 0 or more, got {arguments.seed}")
    if any(request.partition(":")[0] == "unips" for request in arguments.method):
        return
    for option in ("weights", "canonical_size", "uniform_contexts"):
        if getattr(arguments, option):
            raise InputError(
                f"--{option.replace('_', '-')}: expected the method unips, got "
                f"--method {' '.join(arguments.method)}; add unips or leave it out"
            )


def _check_workdir(workdir: Path, benchmark: Benchmark) -> None:
    inside = workdir.resolve().is_relative_to(benchmark.root.resolve())
    if inside:
        raise InputError(f"--workdir {workdir} lies inside the data; choose another")
    if workdir.exists() and not workdir.is_dir():
        raise InputError(f"--workdir {workdir} is not a folder")


def _evaluate(plan: runner.Plan, store: Store, *, pictures: bool) -> None:
    tasks = runner.tasks_of(plan)
    left = [task for task in tasks if not store.done(task.name)]
    for _ in track(runner.execute(plan, left, store), "evaluating", total=len(left)):
        pass
    results = summary.Results(
        plan.benchmark.name,
        plan.protocol.label,
        {variant.label: variant.about for variant in plan.variants},
        plan.counts,
        runner.collect(tasks, store),
    )
    tables = summary.tables(results)
    written = [publish.write_tables(store, tables)]
    if plan.benchmark.name == "diligent102":
        written.append(publish.write_submissions(store, results))
    if pictures:
        drawn = publish.make_exhibits(plan, results, store)
        exhibits = list(track(drawn, "drawing", total=len(plan.benchmark)))
        written.append(publish.write_report(store, results, tables, exhibits))
    _print(tables[0])
    for path in written:
        print(f"wrote {path}")


def _print(table: summary.Table) -> None:
    from rich.console import Console
    from rich.table import Table as RichTable

    console = Console(width=None if sys.stdout.isatty() else 160, markup=False)
    shown = RichTable(title=table.title)
    for column in table.columns:
        shown.add_column(column)
    for row in table.rows:
        shown.add_row(*map(text_of, row))
    console.print(shown)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="unips eval", description="Evaluate UniPS and other methods on benchmarks."
    )
    add = parser.add_argument
    add("--benchmark", required=True, choices=list(BENCHMARKS), help="which data")
    add("--root", required=True, metavar="DIR", help="the benchmark's folder")
    add("--workdir", required=True, metavar="OUT", help="where results are kept")
    add(
        *("--method", "-m"),
        nargs="+",
        default=["unips"],
        metavar="NAME",
        help="name or name:option=value,...; 'classical' stands for the baselines "
        f"without weights; names: {', '.join(NAMES)} (default: unips); the constant "
        "normal is always added",
    )
    add(
        "--weights",
        nargs="+",
        default=[],
        metavar="NAME",
        help="of unips: shipped names or files, each a method (default: tiny)",
    )
    add("--objects", nargs="+", default=[], metavar="NAME", help="only these objects")
    add(
        "--protocol",
        choices=["crop", "native"],
        help="crop: the paper's square crop around the mask; native: the images as "
        "they are (default: what the benchmark's published scores used)",
    )
    add("--crop-size", type=int, metavar="N", help="of the protocol crop; default: 256")
    add(
        "--num-images",
        type=_count,
        nargs="+",
        default=[None],
        metavar="N",
        help="numbers of images, or 'all' (default: all)",
    )
    add("--seed", type=int, default=0, help="of the subsets of images (default: 0)")
    add(
        "--canonical-size",
        type=int,
        nargs="+",
        default=[],
        metavar="N",
        help="compare these sizes of the encoder's images (the paper's Table 4)",
    )
    add(
        "--uniform-contexts",
        action="store_true",
        help="also with contexts that are uniform over space (the paper's Table 5)",
    )
    add("--no-pictures", action="store_true", help="tables only: no sheets, no report")
    return parser


def _count(text: str) -> int | None:
    return None if text == "all" else int(text)


main = command(_main)

if __name__ == "__main__":
    sys.exit(main())
