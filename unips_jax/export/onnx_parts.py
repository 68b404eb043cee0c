"""The ONNX operators of what takes parts of arrays: slices, padding, places.

As in `onnx_operators`, each function adds the nodes of one equation.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
from jax.lax import GatherScatterMode

if TYPE_CHECKING:
    from unips_jax.export.onnx_graph import Graph, Value

_LEAST = -(2**31)


def result_of(equation: Any) -> tuple[tuple[Any, ...], np.dtype]:
    """Shape and type of an equation's first result."""
    aval = equation.outvars[0].aval
    return tuple(aval.shape), np.dtype(aval.dtype)


def whole_inputs(graph: "Graph", equation: Any, inputs: list["Value"]) -> list["Value"]:
    """The inputs, with the broadcasts that were put off."""
    avals = [atom.aval for atom in equation.invars]
    return [graph.whole(x, a.shape) for x, a in zip(inputs, avals, strict=True)]


def reverse(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    """Turns axes around (`rev`)."""
    (x,), axes = inputs, equation.params["dimensions"]
    count = len(axes)
    bounds = [np.full(count, -1), np.full(count, _LEAST), axes, np.full(count, -1)]
    return graph.node(
        "Slice", [x, *(np.asarray(b, np.int64) for b in bounds)], (x.shape, x.dtype)
    )


def cut(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    """A slice with steps (`slice`); its bounds may be symbols."""
    (x,), params = whole_inputs(graph, equation, inputs), equation.params
    axes = range(len(x.shape))
    steps = params["strides"] or [1] * len(axes)
    bounds = (graph.dims(params["start_indices"]), graph.dims(params["limit_indices"]))
    more = [np.array(values, np.int64) for values in (axes, steps)]
    return graph.node("Slice", [x, *bounds, *more], result_of(equation))


def pad(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    """Adds a margin, or takes one away where it is negative."""
    x, fill = whole_inputs(graph, equation, inputs)
    before, after, within = zip(*equation.params["padding_config"], strict=True)
    if any(within):
        raise NotImplementedError("no ONNX operator pads between elements")
    pads = graph.dims([*before, *after])
    return graph.node("Pad", [x, pads, fill], result_of(equation))


def gather(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    """Slices at indices along an axis (`x[index]`), or a grid of known ones."""
    x, index = whole_inputs(graph, equation, inputs)
    params, (shape, dtype) = equation.params, result_of(equation)
    numbers, sizes = params["dimension_numbers"], params["slice_sizes"]
    if isinstance(index, np.ndarray) and index.ndim == 1:
        return _one_slice(graph, x, index, equation)
    places, axes = tuple(index.shape[:-1]), numbers.start_index_map
    new = range(axes[0], axes[0] + len(places))
    kept = [i for i in range(len(shape)) if i not in new]
    others = [i for i in range(len(x.shape)) if i not in axes]
    if (
        numbers.collapsed_slice_dims != axes
        or numbers.operand_batching_dims
        or list(numbers.offset_dims) != kept
        or not all(sizes[i] == x.shape[i] for i in others)
    ):
        raise NotImplementedError(f"no ONNX operator is known for: {equation}")
    known = params["mode"] == GatherScatterMode.PROMISE_IN_BOUNDS
    if len(axes) > 1:
        lines = _lines(index)
        if lines is None or not known or tuple(axes) != tuple(new):
            raise NotImplementedError(f"no ONNX operator is known for: {equation}")
        for axis, line in zip(axes, lines, strict=True):
            cut = (*x.shape[:axis], len(line), *x.shape[axis + 1 :])
            x = graph.node("Gather", [x, line], (cut, dtype), axis=axis)
        return x
    axis = axes[0]
    index = graph.cast(graph.reshape(index, places), np.int64)
    if known:
        return graph.node("Gather", [x, index], (shape, dtype), axis=axis)
    last = graph.node(
        "Sub", [graph.dim(x.shape[axis]), np.array(1, np.int64)], ((1,), np.int64)
    )
    inside = graph.node("Max", [index, np.array(0, np.int64)], (places, np.int64))
    inside = graph.node("Min", [inside, last], (places, np.int64))
    value = graph.node("Gather", [x, inside], (shape, dtype), axis=axis)
    if params["mode"] == GatherScatterMode.CLIP:
        return value
    hit = graph.node("Equal", [index, inside], (places, bool))
    aligned = [d if i not in kept else 1 for i, d in enumerate(shape)]
    fill = params["fill_value"]
    if fill is None:
        fill = np.nan if np.issubdtype(dtype, np.floating) else 0
    filling = [graph.reshape(hit, aligned), value, np.asarray(fill, dtype)]
    return graph.node("Where", filling, (shape, dtype))


def _lines(index: "Value") -> list[np.ndarray] | None:
    """The rows, columns and so on of a known grid of places `[..., axes]`, if it is."""
    count = index.shape[-1]
    if not isinstance(index, np.ndarray) or index.ndim != count + 1:
        return None
    lines = []
    for axis in range(count):
        values = np.moveaxis(index[..., axis], axis, 0).reshape(index.shape[axis], -1)
        if (values != values[:, :1]).any():
            return None
        lines.append(values[:, 0].astype(np.int64))
    return lines


def _one_slice(graph: "Graph", x: "Value", index: np.ndarray, equation: Any) -> "Value":
    """What `x[3]` becomes where a dimension is a symbol; the place is known."""
    params, (shape, dtype) = equation.params, result_of(equation)
    axes, sizes = params["dimension_numbers"].start_index_map, params["slice_sizes"]
    starts = [int(i) for i in index]
    cut = list(x.shape)
    for axis, start in zip(axes, starts, strict=True):
        if isinstance(x.shape[axis], int) and start + sizes[axis] > x.shape[axis]:
            raise NotImplementedError(f"no ONNX operator is known for: {equation}")
        cut[axis] = sizes[axis]
    ends = graph.dims([i + sizes[axis] for axis, i in zip(axes, starts, strict=True)])
    bounds = [np.array(starts, np.int64), ends, np.array(axes, np.int64)]
    return graph.reshape(graph.node("Slice", [x, *bounds], (cut, dtype)), shape)
