"""The methods that can be evaluated: UniPS, the baselines, and anyone's.

A method is asked for as `name` or `name:option=value,option=value`, such as
`least-squares:keep=(0.2,0.8)`. GCNet takes PS-FCN's weights, or the name of a
calibrated baseline, for the normals: `gcnet:weights=GCNET,normals=PS_FCN`.
`unips:fast=true` decodes as `--fast` does; `unips:lights=true` is given the lights of
benchmarks that know them, `unips:lights=20` with errors of 20 degrees. Of any method
`sign=oracle` takes the signs of x, y and z that the truth likes best, as publications
do where convex and concave look the same; a dagger marks its results. `files:DIR` are
normals that another program made (`normal_files`), `python:module:factory` a method in
a module of the user's (`foreign`). Modules are imported when a method of theirs is
asked for.
"""

import dataclasses
import importlib
import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from unips_jax.baselines.method import Method, Observed, Unsupported
from unips_jax.errors import InputError
from unips_jax.evaluation.foreign import from_module, from_package, installed
from unips_jax.evaluation.normal_files import from_files
from unips_jax.evaluation.registry import BASELINES, CLASSICAL, NAMES
from unips_jax.evaluation.variants import (
    Variant,
    built,
    described,
    hashed,
    label_of,
    parse_options,
    take_oracle,
)
from unips_jax.provenance import code_hash

if TYPE_CHECKING:
    from unips_jax.models.network import UniversalNetwork


class UnipsOptions(NamedTuple):
    """How UniPS is evaluated."""

    weights: Sequence[str]  # names of shipped weights, or files; each is a method
    # sides of the encoder's images to compare (Table 4); the weights' own where empty
    canonical_sizes: Sequence[int] = ()
    # also evaluate with contexts averaged over space (Table 5)
    uniform_contexts: bool = False


def load_variants(requests: Sequence[str], unips: UnipsOptions) -> list[Variant]:
    """Readies the methods asked for, and the constant normal, the floor of any table.

    A request is `name` or `name:option=value,...`; `classical` stands for `CLASSICAL`.
    """
    variants: list[Variant] = []
    expanded = [
        name for r in requests for name in (CLASSICAL if r == "classical" else [r])
    ]
    for request in dict.fromkeys([*expanded, "constant"]):
        name, _, options = request.partition(":")
        if name == "unips":
            asked = parse_options(request, options)
            oracle = take_oracle(asked)
            asked = _unips_options(request, asked)
            variants += _unips_variants(unips, asked, oracle=oracle)
        elif name == "files":
            variants.append(from_files(request))
        elif name == "python":
            variants.append(from_module(request))
        elif name not in BASELINES and name in (others := installed()):
            variants.append(from_package(request, others[name]))
        else:
            variants.append(_baseline(request, name, parse_options(request, options)))
    labels = [variant.label for variant in variants]
    for label in labels:
        if labels.count(label) > 1:
            raise InputError(
                f"two methods are called {label!r}; rename the weights, or add "
                "name=... to the options of files:DIR or python:module:factory"
            )
    return variants


def _baseline(request: str, name: str, options: dict[str, Any]) -> Variant:
    if name not in BASELINES:
        known = [*NAMES, "classical", *installed()]
        raise InputError(
            f"no method {name!r}; there are {', '.join(known)}, files:DIR and "
            "python:module:factory"
        )
    baseline = BASELINES[name]
    _check_files(request, name, options)
    oracle = take_oracle(options)
    label_options = dict(options)
    options = {**baseline.fixed, **options}
    key = {"method": name, "options": hashed(options), "oracle": oracle}
    if "normals" in options:
        options["normals"] = _calibrated(request, str(options["normals"]))
    try:
        module = importlib.import_module(f"unips_jax.baselines.{baseline.module}")
        factory: Callable[..., Method] = getattr(module, baseline.factory)
    except (ModuleNotFoundError, AttributeError) as error:
        raise InputError(f"method {name!r} is not in this version") from error
    method = built(request, factory, options)
    key["method_code"] = code_hash(f"baselines.{baseline.module}")
    # Two readings of one paper: every row names its own.
    defaults = inspect.signature(factory).parameters
    for option in [name for name in ("norm", "per") if name in defaults]:
        label_options.setdefault(option, defaults[option].default)
    label = label_of(name, label_options, oracle=oracle)
    return Variant(label, key, method, described(baseline.about, oracle=oracle), oracle)


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
    if value == "woodham":  # whose clip is for lights of a known scale
        value = "least-squares"
    return _baseline(value, value, {}).run


def _unips_options(request: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """`fast`, True, and `lights`, degrees of error; those that are asked for."""
    found: dict[str, Any] = {}
    for name, value in options.items():
        known = True if value == "true" else value
        if name == "fast" and known is True:
            found["fast"] = True
        elif name == "lights" and (
            known is True
            or (type(known) in (int, float) and 0 <= known < 90)  # not False
        ):
            found["lights"] = 0.0 if known is True else float(known)
        else:
            raise InputError(
                f"method {request!r}: expected fast=true, lights=true, lights=20 "
                f"(degrees of error, below 90) or sign=oracle, got {name}={value}; "
                "weights are given by --weights, further options by --canonical-size "
                "and --uniform-contexts"
            )
    return found


def _unips_variants(
    unips: UnipsOptions, asked: Mapping[str, Any], *, oracle: bool
) -> Iterator[Variant]:
    from unips_jax.models.config import require_known_lights
    from unips_jax.weights import load_weights, weights_hash

    several = len(unips.weights) > 1
    for source in unips.weights:
        network = load_weights(source)
        config, weights = network.config, weights_hash(network)
        if "lights" in asked:
            try:
                require_known_lights(config)
            except ValueError as error:
                raise InputError(f"--weights {source}: {error}") from None
        base = label_of("unips", {}, oracle=oracle)
        base += f" {Path(source).stem}" * several
        base += " fast" * ("fast" in asked)
        if "lights" in asked:
            base += " lights" + f" {asked['lights']:g}" * (asked["lights"] > 0)
        sizes = list(unips.canonical_sizes) or [config.canonical_size]
        for size in sizes:
            try:
                sized = dataclasses.replace(config, canonical_size=size)
            except ValueError as error:
                raise InputError(f"--canonical-size: {error}") from error
            own = sizes == [config.canonical_size]
            label = base if own else f"{base} canonical {size}"
            for uniform in (False, True)[: 1 + unips.uniform_contexts]:
                options = {"canonical_size": size, "uniform_contexts": uniform}
                options |= asked
                key: dict[str, Any] = {"method": "unips", "options": options}
                key["weights"] = weights
                key["method_code"] = code_hash("estimation.streaming")
                if oracle:
                    key["oracle"] = True
                about = "UniPS (Ikehata, CVPR 2022) with the weights "
                about += f"{Path(source).name}, hash {weights}"
                resized = dataclasses.replace(network, config=sized)
                yield Variant(
                    label + " uniform contexts" * uniform,
                    key,
                    _unips(resized, uniform, **asked),
                    described(about, oracle=oracle),
                    oracle,
                )


def _unips(
    network: "UniversalNetwork",
    uniform_contexts: bool,
    fast: bool = False,
    lights: float | None = None,
) -> Method:
    from unips_jax.estimation.streaming import estimate_photographs

    def method(observed: Observed) -> np.ndarray:
        known = None
        if lights is not None:
            if observed.lights is None:
                raise Unsupported("unips:lights needs known lights")
            known = roughly_known(observed.lights.directions, lights)
        return estimate_photographs(
            network,
            observed.images,
            observed.mask,
            lights=known,
            fast=fast,
            uniform_contexts=uniform_contexts,
        )

    return method


def roughly_known(directions: np.ndarray, degrees: float) -> np.ndarray:
    """Directions `[N, 3]` with errors whose root mean square is `degrees`.

    Their length is the cosine of that, as `estimate_normals` takes them. The errors are
    the same for the same number of lights.
    """
    error = np.radians(degrees)
    noise = np.random.default_rng(len(directions)).normal(size=directions.shape)
    noise -= directions * np.sum(noise * directions, axis=-1, keepdims=True)
    moved = directions + np.tan(error) * noise / 2**0.5
    moved /= np.linalg.norm(moved, axis=-1, keepdims=True)
    return np.asarray(moved * np.cos(error), np.float32)
