"""Evaluates UniPS and other methods on benchmarks, with tables and a report.

Everything is checked before any work starts: the benchmark's layout and files, the
methods, their weights. Results are kept in the work folder object by object; the same
command started again, or twice at once, does only what is left.
"""

import dataclasses
import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import tyro

from unips_jax.cli.cluster import RayOptions, spread
from unips_jax.console import command, one_of, parse, print_table, start_jax, track
from unips_jax.errors import InputError
from unips_jax.evaluation import plan as planning
from unips_jax.evaluation.benchmarks import BENCHMARKS, Benchmark, open_benchmark
from unips_jax.evaluation.methods import UnipsOptions, load_variants
from unips_jax.evaluation.protocols import Protocol
from unips_jax.evaluation.registry import CLASSICAL, NAMES
from unips_jax.evaluation.store import Store

_T = TypeVar("_T")
_Several = Annotated[tuple[_T, ...], tyro.conf.arg(metavar="NAME [NAME ...]")]


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `unips eval`.

    Attributes:
        benchmark: which data.
        root: the benchmark's folder; it is never written to.
        workdir: where results are kept.
        method: name or name:option=value,...; 'classical' stands for several; the
            constant normal is always added.
        weights: of unips, shipped names or files, each a method; tiny if not given.
        objects: only these.
        protocol: crop, the paper's square crop around the mask, or native, the images
            as they are; what the benchmark's published scores used if not given.
        crop_size: side in pixels, of the protocol crop; 256 if not given.
        num_images: numbers of images, or 'all'.
        seeds: of the subsets of images; figures are means over them.
        canonical_size: compare these sizes of the encoder's images (the paper's
            Table 4).
        uniform_contexts: also with contexts that are uniform over space (the paper's
            Table 5).
        no_pictures: tables only, no sheets and no report.
        write_inputs: write photographs and masks as methods are given them to
            OUT/inputs, for programs that cannot be called from here, and end.
        where: where objects are worked on.
    """

    benchmark: Annotated[str, one_of(list(BENCHMARKS))]
    root: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    workdir: Annotated[Path, tyro.conf.arg(metavar="OUT")]
    method: Annotated[
        tuple[str, ...],
        tyro.conf.arg(
            aliases=["-m"],
            metavar="NAME [NAME ...]",
            help_behavior_hint=f"Names: {', '.join(NAMES)}, classical "
            f"({', '.join(CLASSICAL)}); files:DIR, normals that another program made; "
            "python:package.module:factory, your own. (default: unips)",
        ),
    ] = ("unips",)
    weights: _Several[str] = ()
    objects: _Several[str] = ()
    protocol: Literal["crop", "native"] | None = None
    crop_size: int | None = None
    num_images: Annotated[
        tuple[int | Literal["all"], ...], tyro.conf.arg(metavar="N [N ...]")
    ] = ("all",)
    seeds: Annotated[
        tuple[int, ...], tyro.conf.arg(metavar="N [N ...]", aliases=["--seed"])
    ] = (0,)
    canonical_size: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N [N ...]")] = ()
    uniform_contexts: bool = False
    no_pictures: bool = False
    write_inputs: bool = False
    where: Annotated[RayOptions, tyro.conf.arg(name="")] = RayOptions()


@command
def main(argv: Sequence[str] | None = None) -> None:
    """`unips eval`."""
    options = parse(Options, argv, prog="unips eval", description=__doc__)
    plan = _plan(options)
    if options.write_inputs:
        from unips_jax.evaluation import publish

        folder = options.workdir / "inputs"
        objects = publish.write_inputs(plan, folder)
        for _ in track(objects, "writing", total=len(plan.benchmark)):
            pass
        return print(f"wrote {folder}")
    planning.check_normal_files(plan)
    store = Store(options.workdir)
    if options.where.ray:
        _spread(plan, store, options)
    typed = shlex.join(["unips", "eval", *(sys.argv[1:] if argv is None else argv)])
    _evaluate(plan, store, typed, pictures=not options.no_pictures)


def _plan(options: Options) -> planning.Plan:
    workdir = options.workdir
    _check_options(options)
    benchmark = open_benchmark(options.benchmark, options.root, objects=options.objects)
    _check_workdir(workdir, benchmark)
    if benchmark.left_out and not options.objects:
        first, *more = [path.name for path in benchmark.left_out]
        others = f" and {len(more)} more" * bool(more)
        print(
            f"warning: {first}{others}: photographs, but no normal map named normal.*, "
            "normals.* or Normal_gt.*: left out",
            file=sys.stderr,
        )
    name: Any = options.protocol or benchmark.default_protocol
    protocol = Protocol(name)
    if options.crop_size is not None:
        if name == "native":
            raise InputError(
                f"--crop-size {options.crop_size}: expected --protocol crop, got "
                "native; change the protocol or leave the size out"
            )
        protocol = Protocol(name, options.crop_size)
    if benchmark.name == "diligent102" and protocol.name != "native":
        raise InputError("diligent102: submissions need --protocol native")
    counts = [None if n == "all" else n for n in dict.fromkeys(options.num_images)]
    planning.check_counts(benchmark, counts)
    start_jax()
    unips = UnipsOptions(
        options.weights or ("tiny",), options.canonical_size, options.uniform_contexts
    )
    variants = load_variants(options.method, unips)
    fingerprints = list(
        track(planning.check_data(benchmark), "checking data", total=len(benchmark))
    )
    return planning.Plan(
        benchmark,
        variants,
        protocol,
        counts,
        tuple(dict.fromkeys(options.seeds)),
        fingerprints,
    )


def _spread(plan: planning.Plan, store: Store, options: Options) -> None:
    """Works on objects anywhere in a cluster; what is done is found in the store."""
    left = [task for task in planning.tasks_of(plan) if not store.done(task.name)]
    entries = dict.fromkeys(plan.benchmark.entries[task.index].name for task in left)
    pieces = [
        (name, dataclasses.replace(options, objects=(name,), where=RayOptions()))
        for name in entries
    ]
    failed = spread(_evaluate_one, pieces, options.where, "evaluating")
    if failed:
        name, reason = next(iter(failed.items()))
        raise InputError(
            f"{len(failed)} of {len(pieces)} objects could not be evaluated; {name}: "
            f"{reason}; the others are in {options.workdir}"
        )


def _evaluate_one(options: Options) -> None:
    """The tasks of one object."""
    from unips_jax.evaluation import runner

    plan = _plan(options)
    tasks = planning.tasks_of(plan)
    # What fails is tried, and named, once more where the tables are made.
    for _ in runner.execute(plan, tasks, Store(options.workdir), {}):
        pass


def _check_options(options: Options) -> None:
    options.where.check()
    if min(options.seeds, default=0) < 0:
        raise InputError(f"--seeds: expected 0 or more, got {min(options.seeds)}")
    for option in ("method", "num_images", "seeds"):
        if not getattr(options, option):
            raise InputError(f"--{option.replace('_', '-')}: expected some, got none")
    if any(request.partition(":")[0] == "unips" for request in options.method):
        return
    for option in ("weights", "canonical_size", "uniform_contexts"):
        if getattr(options, option):
            raise InputError(
                f"--{option.replace('_', '-')}: expected the method unips, got "
                f"--method {' '.join(options.method)}; add unips or leave it out"
            )


def _check_workdir(workdir: Path, benchmark: Benchmark) -> None:
    place, root = map(os.path.realpath, (workdir, benchmark.root))
    if Path(place).is_relative_to(root):
        raise InputError(f"--workdir {workdir} lies inside the data; choose another")
    if workdir.exists() and not workdir.is_dir():
        raise InputError(f"--workdir {workdir} is not a folder")


def _evaluate(plan: planning.Plan, store: Store, typed: str, *, pictures: bool) -> None:
    from unips_jax.evaluation import publish, runner, summary
    from unips_jax.evaluation.results import Results

    tasks = planning.tasks_of(plan)
    left = [task for task in tasks if not store.done(task.name)]
    failed: dict[str, str] = {}
    finished = runner.execute(plan, left, store, failed)
    for _ in track(finished, "evaluating", total=len(left)):
        pass
    results = Results(
        plan.benchmark.name,
        plan.protocol.label,
        {variant.label: variant.about for variant in plan.variants},
        plan.counts,
        runner.collect(plan, tasks, store, failed),
        plan.seeds,
    )
    tables = summary.tables(results)
    written = [publish.write_tables(store, tables)]
    publish.write_figures(store, results)
    if plan.benchmark.name == "diligent102":
        written.append(publish.write_submissions(store, results))
    if pictures and not failed:
        drawn = publish.make_exhibits(plan, results, store)
        exhibits = list(track(drawn, "drawing", total=len(plan.benchmark)))
        header = publish.header_of(plan, typed)
        written.append(publish.write_report(store, header, results, tables, exhibits))
    for label, line in summary.turned_axes(results).items():
        print(f"warning: {label}: {line}", file=sys.stderr)
    table = tables[0]
    print_table(table.title, table.names, table.shown)
    for path in written:
        print(f"wrote {path}")
    if failed:
        task = next(task for task in left if task.name in failed)
        raise InputError(
            f"method {task.variant.label!r} failed on "
            f"{plan.benchmark.entries[task.index].name}: {failed[task.name]}; "
            f"{len(failed)} of {len(tasks)} results are missing, and with them sheets "
            "and report; the same command tries them again"
        )


if __name__ == "__main__":
    sys.exit(main())
