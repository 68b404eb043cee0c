"""Networks as files that other programs load, without this package and without Flax.

ONNX: `encoder.onnx` and `decoder.onnx`, for onnxruntime in any language and in
browsers. StableHLO: `estimate.stablehlo`, one function of photographs and mask that
`jax.export.deserialize` reads. `export.json` lists what is in them. Parameters are
inside. See docs/export.md.
"""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from unips_jax.errors import InputError, install_hint
from unips_jax.estimation.pure import estimate_normals
from unips_jax.export.functions import decode_pixels, encode_set
from unips_jax.io.door import write_json, write_whole
from unips_jax.io.results import appearing_at_once, file_hash
from unips_jax.models.config import ModelConfig
from unips_jax.models.config_json import to_json
from unips_jax.models.network import UniversalNetwork
from unips_jax.version import __version__
from unips_jax.weights import weights_hash

Format = Literal["onnx", "stablehlo"]

RECORD = "export.json"
# Of the files' inputs and outputs; a change that breaks what loads them raises it.
VERSION = 1
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
# The most photographs of a set: what is compiled for any number must know one.
MAX_IMAGES = 256

_INPUTS = {
    "encoder": ("images", "mask"),
    "decoder": ("contexts", "views", "gains", "pixels", "rows", "columns"),
    "estimate": ("images", "mask"),
}
_OUTPUTS = {
    "encoder": ("contexts", "views", "gains"),
    "decoder": ("normals",),
    "estimate": ("normals",),
}
_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "encoder": encode_set,
    "decoder": decode_pixels,
}


def write_export(
    target: Path,
    network: UniversalNetwork,
    *,
    format: Format,
    name: str,
    half: bool = False,
    decoder_views: int | None = None,
) -> dict[str, Any]:
    """Writes a network; all files appear, or none. Returns what `export.json` holds.

    What is written computes in float32. With `half`, parameters are rounded to half
    precision first; those that it holds exactly, as the shipped ones, are stored so in
    any case. `name`, of the weights, is for the record.

    `decoder_views`: how many views ONNX's decoder takes; all that the encoder gives if
    None. Of one, the caller turns the mirrored view: columns count from the right, and
    x of the normals changes its sign.
    """
    own = weights_hash(network)  # as records of results have it
    config = dataclasses.replace(network.config, dtype="float32", remat=False)
    network = dataclasses.replace(network, config=config)
    if half:
        network = jax.tree.map(lambda x: np.asarray(x, np.float16), network)
    network = jax.tree.map(lambda x: np.asarray(x, np.float32), network)
    record = {
        "format": format,
        "version": VERSION,
        "weights": {"name": name, "hash": own},
        "config": json.loads(to_json(config)),
        **({} if decoder_views is None else {"decoder_views": decoder_views}),
        **_versions(),
    }
    write = write_onnx if format == "onnx" else write_stablehlo
    with appearing_at_once(target, record=RECORD) as place:
        write(place, network, record)
        files = {file.name: file_hash(file) for file in sorted(place.iterdir())}
        record["files"] = files
        write_json(place / RECORD, record, indent=2)
    return record


def write_onnx(folder: Path, network: UniversalNetwork, record: dict[str, Any]) -> None:
    """Writes `encoder.onnx` and `decoder.onnx`; the record becomes their metadata."""
    try:
        import onnx

        from unips_jax.export.onnx_graph import Graph
    except ImportError as error:
        raise _missing("onnx", error) from error
    for name in ("encoder", "decoder"):
        shapes = _shapes(network.config, record.get("decoder_views"))
        arguments = {key: shapes[key] for key in _INPUTS[name]}
        traced = jax.make_jaxpr(_FUNCTIONS[name])(network, *arguments.values())
        graph = Graph()
        inputs = [graph.input(key, shape) for key, shape in arguments.items()]
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(network)]
        values = graph.add_jaxpr(traced.jaxpr, traced.consts, [*leaves, *inputs])
        outputs = {
            key: graph.whole(value, aval.shape)
            for key, value, aval in zip(
                _OUTPUTS[name], values, traced.out_avals, strict=True
            )
        }
        metadata = {"unips_jax": json.dumps(record, sort_keys=True)}
        model = graph.model(outputs, f"unips_{name}", metadata)
        onnx.checker.check_model(model)
        write_whole(folder / f"{name}.onnx", model.SerializeToString(), sync=False)


def write_stablehlo(
    folder: Path, network: UniversalNetwork, record: dict[str, Any]
) -> None:
    """Writes `estimate.stablehlo`, as `jax.export` serialises a function."""
    shapes = _shapes(network.config)
    arguments = [shapes[key] for key in _INPUTS["estimate"]]
    stored = jax.tree.map(_in_half, network)

    def unips_estimate(images: jax.Array, mask: jax.Array) -> jax.Array:
        # `jnp.asarray` would convert them here, and double the file.
        inside = jax.tree.map(
            lambda x: jax.lax.convert_element_type(x, jnp.float32), stored
        )
        return estimate_normals(inside, images, mask)

    exported = export.export(jax.jit(unips_estimate), platforms=PLATFORMS)(*arguments)
    try:
        data = exported.serialize()
    except ImportError as error:
        raise _missing("flatbuffers", error) from error
    write_whole(folder / "estimate.stablehlo", data, sync=False)


def _shapes(config: ModelConfig, views: int | None = None) -> dict[str, Any]:
    """Shapes and types of the functions' inputs, by their names."""
    scope = export.SymbolicScope([f"N <= {MAX_IMAGES}"])
    n, height, width, count = export.symbolic_shape("N, H, W, P", scope=scope)
    views, side = views or (2 if config.mirror else 1), config.context_size
    shape = jax.ShapeDtypeStruct
    contexts = (views, side, side, n, config.context_dim)
    return {
        "images": shape((n, height, width, 3), jnp.float32),
        "mask": shape((height, width), bool),
        "contexts": shape(contexts, jnp.float32),
        "views": shape((views, 4), jnp.int32),
        "gains": shape((n,), jnp.float32),
        "pixels": shape((count, n, 3), jnp.float32),
        "rows": shape((count,), jnp.int32),
        "columns": shape((count,), jnp.int32),
    }


def _in_half(x: np.ndarray) -> np.ndarray:
    """In half precision if that holds it exactly."""
    with np.errstate(over="ignore"):
        half = x.astype(np.float16)
    return half if np.array_equal(half.astype(np.float32), x) else x


def _versions() -> dict[str, str]:
    return {"unips_jax": __version__, "jax": jax.__version__, "license": "Apache-2.0"}


def _missing(package: str, error: Exception) -> InputError:
    return InputError(
        f"{package}: cannot be imported ({error}); {install_hint('export')}"
    )
