"""The methods that can be evaluated, by name: UniPS and the baselines.

A method is asked for as `name` or `name:option=value,option=value`, such as
`woodham:keep=(0.2,0.8)`. Modules are imported when a method of theirs is asked for.
"""

import ast
import dataclasses
import hashlib
import importlib
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from unips_jax.baselines.method import Lights, Method
from unips_jax.command import InputError

BASELINES: dict[str, tuple[str, str]] = {
    "gcnet": ("gcnet", "gcnet"),
    "mpm": ("mpm", "mpm"),
    "variational": ("variational", "variational"),
    "woodham": ("calibrated", "woodham_diligent"),
    "least-squares": ("calibrated", "woodham"),
    "l1": ("calibrated", "robust_l1"),
    "sbl": ("calibrated", "sparse_bayesian"),
    "rpca": ("calibrated", "low_rank"),
    "diffuse-maxima": ("uncalibrated", "diffuse_maxima"),
    "entropy": ("uncalibrated", "entropy"),
    "sh1": ("spherical_harmonics", "spherical_harmonics"),
    "hemisphere": ("balloon", "hemisphere"),
    "constant": ("constant", "constant"),
}
"""Name on the command line: module in `unips_jax.baselines`, factory in it."""

CLASSICAL = (
    *("woodham", "l1", "sbl", "rpca", "diffuse-maxima", "entropy", "sh1"),
    *("hemisphere", "constant"),
)
"""What `classical` stands for on the command line."""

NAMES = ("unips", *BASELINES)


class Variant(NamedTuple):
    """A method with its options: a column of the tables.

    Attributes:
        label: its name in tables, unique in a run.
        key: what its results depend on, as JSON values.
        run: the method.
    """

    label: str
    key: dict[str, Any]
    run: Method


class UnipsOptions(NamedTuple):
    """How UniPS is evaluated.

    Attributes:
        weights: names of shipped weights, or files; each is a method.
        canonical_sizes: sides of the encoder's images to compare (Table 4); the
            weights' own where empty.
        uniform_contexts: also evaluate with contexts averaged over space (Table 5).
    """

    weights: Sequence[str]
    canonical_sizes: Sequence[int] = ()
    uniform_contexts: bool = False


def load_variants(requests: Sequence[str], unips: UnipsOptions) -> list[Variant]:
    """Readies the methods asked for.

    Args:
        requests: `name` or `name:option=value,...`; `classical` stands for the
            baselines that need no weights.
        unips: what `unips` stands for.

    Raises:
        InputError: if a method, an option or weights are not there.
    """
    variants: list[Variant] = []
    expanded = [
        name for r in requests for name in (CLASSICAL if r == "classical" else [r])
    ]
    for request in dict.fromkeys(expanded):
        name, _, options = request.partition(":")
        if name == "unips":
            if options:
                raise InputError(
                    f"method {request!r}: options of unips are given by --weights, "
                    "--canonical-size and --uniform-contexts"
                )
            variants += _unips_variants(unips)
        else:
            variants.append(_baseline(request, name, _parse_options(request)))
    labels = [variant.label for variant in variants]
    for label in labels:
        if labels.count(label) > 1:
            raise InputError(f"two methods are called {label!r}; rename the weights")
    if not variants:
        raise InputError("no method to evaluate")
    return variants


def _parse_options(request: str) -> dict[str, Any]:
    options: dict[str, Any] = {}
    text = request.partition(":")[2]
    # Commas inside parentheses belong to a value.
    for part in re.split(r",(?![^()]*\))", text) if text else []:
        name, equals, value = part.partition("=")
        if not name.isidentifier() or not equals:
            raise InputError(f"method {request!r}: expected option=value, got {part!r}")
        try:
            options[name] = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            options[name] = value
    return options


def _baseline(request: str, name: str, options: dict[str, Any]) -> Variant:
    if name not in BASELINES:
        raise InputError(f"no method {name!r}; there are {', '.join(NAMES)}, classical")
    module, function = BASELINES[name]
    try:
        imported = importlib.import_module(f"unips_jax.baselines.{module}")
        factory: Callable[..., Method] = getattr(imported, function)
    except (ModuleNotFoundError, AttributeError) as error:
        raise InputError(f"method {name!r} is not in this version ({error})") from error
    try:
        method = factory(**options)
    except (TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"method {request!r}: {error}") from error
    hashed = {key: _file_hash(value) for key, value in options.items()}
    return Variant(request, {"method": name, "options": hashed}, method)


def _file_hash(value: Any) -> Any:
    """An option's value in result keys: a file stands for its contents."""
    if isinstance(value, str) and Path(value).is_file():
        return hashlib.blake2b(Path(value).read_bytes(), digest_size=16).hexdigest()
    return value


def _unips_variants(unips: UnipsOptions) -> Iterator[Variant]:
    from unips_jax.estimation import estimate_photographs
    from unips_jax.weights import load_weights

    several = len(unips.weights) > 1
    for source in unips.weights:
        config, params = load_weights(source)
        weights = params_hash(config, params)
        base = f"unips {Path(source).stem}" if several else "unips"
        sizes = list(unips.canonical_sizes) or [config.canonical_size]
        for size in sizes:
            try:
                sized = dataclasses.replace(config, canonical_size=size)
            except ValueError as error:
                raise InputError(f"--canonical-size: {error}") from error
            label = base if len(sizes) == 1 else f"{base} canonical {size}"
            for uniform in (False, True)[: 1 + unips.uniform_contexts]:

                def run(
                    images: np.ndarray,
                    mask: np.ndarray,
                    *,
                    lights: Lights | None = None,
                    focal: float | None = None,
                    params: Any = params,
                    config: Any = sized,
                    uniform: bool = uniform,
                ) -> np.ndarray:
                    del lights, focal
                    return estimate_photographs(
                        params, images, mask, config=config, uniform_contexts=uniform
                    )

                options = {"canonical_size": size, "uniform_contexts": uniform}
                yield Variant(
                    label + " uniform contexts" * uniform,
                    {"method": "unips", "options": options, "weights": weights},
                    run,
                )


def params_hash(config: Any, params: Any) -> str:
    """A hash of a network's configuration and parameters.

    Args:
        config: a configuration dataclass.
        params: nested dictionaries of arrays.
    """
    from unips_jax.config import to_json

    digest = hashlib.blake2b(to_json(config).encode(), digest_size=16)

    def add(path: str, value: Any) -> None:
        if isinstance(value, dict):
            for name in sorted(value):
                add(f"{path}/{name}", value[name])
            return
        array = np.ascontiguousarray(value)
        digest.update(f"{path}:{array.dtype}{array.shape}".encode())
        digest.update(array.tobytes())

    add("", params)
    return digest.hexdigest()
