"""The methods that can be evaluated, by name: UniPS and the baselines.

A method is asked for as `name` or `name:option=value,option=value`, such as
`least-squares:keep=(0.2,0.8)`. GCNet takes PS-FCN's weights, or the name of a
calibrated baseline, for the normals: `gcnet:weights=GCNET,normals=PS_FCN`. Of any
method `sign=oracle` takes the signs of x, y and z that the truth likes best, as
publications do where convex and concave cannot be told apart; a dagger marks its
results. Modules are imported when a method of theirs is asked for.
"""

import ast
import dataclasses
import hashlib
import importlib
import inspect
import re
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from typeguard import TypeCheckError, check_type

from unips_jax.baselines.method import Method, Observed
from unips_jax.errors import InputError
from unips_jax.evaluation.registry import BASELINES, CLASSICAL, NAMES
from unips_jax.provenance import code_hash

if TYPE_CHECKING:
    from unips_jax.models.network import UniversalNetwork


class Variant(NamedTuple):
    """A method with its options: a column of the tables.

    Attributes:
        label: its name in tables, unique in a run.
        key: what its results depend on, as JSON values.
        run: the method.
        about: what it is, one line.
        oracle: whether the truth chooses the signs of its normals.
    """

    label: str
    key: dict[str, Any]
    run: Method
    about: str = ""
    oracle: bool = False


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
    """Readies the methods asked for, and the constant normal, the floor of any table.

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
    for request in dict.fromkeys([*expanded, "constant"]):
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
    baseline = BASELINES[name]
    _check_files(request, name, options)
    oracle = options.get("sign") == "oracle"
    if oracle:
        del options["sign"]
    told = dict(options)
    options = {**baseline.fixed, **options}
    hashed = {key: _file_hash(value) for key, value in options.items()}
    if "normals" in options:
        options["normals"] = _calibrated(request, str(options["normals"]))
    try:
        module = importlib.import_module(f"unips_jax.baselines.{baseline.module}")
        factory: Callable[..., Method] = getattr(module, baseline.factory)
    except (ModuleNotFoundError, AttributeError) as error:
        raise InputError(f"method {name!r} is not in this version") from error
    try:
        _check_types(factory, options)
        method = factory(**options)
    except (TypeError, ValueError) as error:
        raise InputError(f"method {request!r}: {error}") from error
    key = {
        **{"method": name, "options": hashed, "oracle": oracle},
        "method_code": code_hash(f"baselines.{baseline.module}"),
    }
    about = baseline.about
    if oracle:
        about += ". \N{DAGGER}: signs of x, y and z chosen by the truth"
    return Variant(_label(name, told, factory, oracle), key, method, about, oracle)


def _check_types(factory: Callable[..., Method], options: Mapping[str, Any]) -> None:
    kinds = typing.get_type_hints(factory)
    for name in kinds.keys() & options.keys():
        try:
            check_type(options[name], kinds[name])
        except TypeCheckError:
            wanted, got = inspect.formatannotation(kinds[name]), options[name]
            raise TypeError(f"{name}: expected {wanted}, got {got!r}") from None


def _label(
    name: str, options: dict[str, Any], factory: Callable[..., Method], oracle: bool
) -> str:
    """The method with its options, without folders; every row must tell some."""
    defaults = inspect.signature(factory).parameters
    for told in ("norm", "per"):
        if told in defaults:
            options.setdefault(told, defaults[told].default)
    words = [
        f"{key}={Path(value).stem if _is_file(value) else value}"
        for key, value in options.items()
    ]
    return name + "\N{DAGGER}" * oracle + ":" * bool(words) + ",".join(words)


def _is_file(value: Any) -> bool:
    return isinstance(value, str) and Path(value).is_file()


def _check_files(request: str, name: str, options: Mapping[str, Any]) -> None:
    """Refuses a method that would find out at the first object what it lacks."""
    network, weights = BASELINES[name].network, options.get("weights")
    if (network or "weights" in options) and not Path(str(weights)).is_file():
        raise InputError(
            f"method {request!r}: expected a file of weights, {name}:weights=FILE, got "
            f"{weights!r}"
        )
    if network:
        from unips_jax.baselines.gcnet.parameters import load_params

        found = load_params(str(weights))[1]
        if found != network:
            raise InputError(
                f"method {request!r}: expected the weights of {network}, but {weights} "
                f"holds those of {found}"
            )
    if network in ("gcnet", "lcnet") and "normals" not in options:
        raise InputError(
            f"method {request!r}: expected what makes the normals, a file of PS-FCN's "
            "weights or a calibrated baseline, got nothing; add ,normals=woodham"
        )


def _calibrated(request: str, value: str) -> Method:
    """The method that finishes GCNet: PS-FCN's weights file, or a baseline's name."""
    if Path(value).is_file():
        return _baseline(f"ps-fcn:weights={value}", "ps-fcn", {"weights": value}).run
    if value not in BASELINES or BASELINES[value].network:
        raise InputError(
            f"method {request!r}: expected as normals a file of PS-FCN's weights or a "
            f"calibrated baseline such as woodham, got {value!r}"
        )
    return _baseline(value, value, {}).run


def _file_hash(value: Any) -> Any:
    """An option's value in result keys: a file stands for its contents."""
    if _is_file(value):
        return hashlib.blake2b(Path(value).read_bytes(), digest_size=16).hexdigest()
    return value


def _unips_variants(unips: UnipsOptions) -> Iterator[Variant]:
    from unips_jax.weights import load_weights, weights_hash

    several = len(unips.weights) > 1
    for source in unips.weights:
        network = load_weights(source)
        config, weights = network.config, weights_hash(network)
        base = f"unips {Path(source).stem}" if several else "unips"
        sizes = list(unips.canonical_sizes) or [config.canonical_size]
        for size in sizes:
            try:
                sized = dataclasses.replace(config, canonical_size=size)
            except ValueError as error:
                raise InputError(f"--canonical-size: {error}") from error
            label = base if len(sizes) == 1 else f"{base} canonical {size}"
            for uniform in (False, True)[: 1 + unips.uniform_contexts]:
                options = {"canonical_size": size, "uniform_contexts": uniform}
                yield Variant(
                    label + " uniform contexts" * uniform,
                    {
                        **{"method": "unips", "options": options, "weights": weights},
                        "method_code": code_hash("estimation.streaming"),
                    },
                    _unips(dataclasses.replace(network, config=sized), uniform),
                    f"UniPS (Ikehata, CVPR 2022) with the weights {Path(source).name}, "
                    f"hash {weights}",
                )


def _unips(network: "UniversalNetwork", uniform_contexts: bool) -> Method:
    from unips_jax.estimation.streaming import estimate_photographs

    def method(observed: Observed) -> np.ndarray:
        return estimate_photographs(
            network,
            observed.images,
            observed.mask,
            uniform_contexts=uniform_contexts,
        )

    return method
