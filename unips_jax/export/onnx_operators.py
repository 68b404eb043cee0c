"""The ONNX operators of JAX's primitives: those the networks are made of.

Each function adds the nodes of one equation to a graph and returns its values. Shapes
are those of the equation, but for operators on elements, which may leave out what ONNX
broadcasts.
"""

import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from unips_jax.export.onnx_parts import (
    cut,
    gather,
    pad,
    result_of,
    reverse,
    whole_inputs,
)

if TYPE_CHECKING:
    from unips_jax.export.onnx_graph import Graph, Tensor, Value

# Primitives that call a function, and the parameter that holds it.
CALLS = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "checkpoint": "jaxpr",
    "remat2": "jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
}


def _broadcast(inputs: Sequence["Value"]) -> tuple[Any, ...]:
    """The shape that operators on elements give."""
    rank = max(len(x.shape) for x in inputs)
    shapes = [(1,) * (rank - len(x.shape)) + tuple(x.shape) for x in inputs]

    def common(dims: tuple[Any, ...]) -> Any:
        others = [d for d in dims if not (isinstance(d, int) and d == 1)]
        return others[0] if others else 1

    return tuple(common(dims) for dims in zip(*shapes, strict=True))


def _elements(*kinds: str) -> Callable[..., "Value"]:
    """An operator on elements, followed by others on its result."""

    def add(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
        shape, (_, dtype) = _broadcast(inputs), result_of(equation)
        first, *rest = kinds
        value = graph.node(first, inputs, (shape, dtype))
        for kind in rest:
            value = graph.node(kind, [value], (shape, dtype))
        return value

    return add


def _same(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    return inputs[0]


def _convert(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    return graph.cast(inputs[0], result_of(equation)[1])


def _square(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    (x,) = inputs
    return graph.node("Mul", [x, x], (x.shape, x.dtype))


def _integer_pow(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    (x,) = inputs
    power = np.asarray(equation.params["y"], x.dtype)
    return graph.node("Pow", [x, power], (x.shape, x.dtype))


def _remainder(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    result = (_broadcast(inputs), inputs[0].dtype)
    return graph.node("Mod", inputs, result, fmod=1)


def _is_finite(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    (x,) = inputs
    tests = [graph.node(kind, [x], (x.shape, bool)) for kind in ("IsInf", "IsNaN")]
    either = graph.node("Or", tests, (x.shape, bool))
    return graph.node("Not", [either], (x.shape, bool))


def _select(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    which, where_false, where_true = inputs
    which = graph.cast(which, bool)
    inputs = [which, where_true, where_false]
    return graph.node("Where", inputs, (_broadcast(inputs), where_true.dtype))


def _clamp(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    least, x, most = inputs
    x = graph.node("Max", [x, least], (_broadcast([x, least]), x.dtype))
    return graph.node("Min", [x, most], (_broadcast([x, most]), x.dtype))


def _reshape(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    (x,) = whole_inputs(graph, equation, inputs)
    return graph.reshape(x, result_of(equation)[0])


def _squeeze(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    (x,), gone = inputs, equation.params["dimensions"]
    return graph.reshape(x, [d for i, d in enumerate(x.shape) if i not in gone])


def _expand_dims(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    (x,), new = inputs, equation.params["dimensions"]
    rest = iter(x.shape)
    rank = len(x.shape) + len(new)
    return graph.reshape(x, [1 if i in new else next(rest) for i in range(rank)])


def _transpose(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    return graph.transpose(inputs[0], equation.params["permutation"])


def _broadcast_in_dim(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    """Only the axes are added; what needs the size asks for it (`Graph.whole`)."""
    x, axes = inputs[0], equation.params["broadcast_dimensions"]
    shape = [1] * len(equation.params["shape"])
    for axis, dim in zip(axes, x.shape, strict=True):
        shape[axis] = dim
    return graph.reshape(x, shape)


def _concatenate(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    inputs = whole_inputs(graph, equation, inputs)
    axis = equation.params["dimension"]
    return graph.node("Concat", inputs, result_of(equation), axis=axis)


def _stack(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    inputs, axis = whole_inputs(graph, equation, inputs), equation.params["axis"]
    parts = [graph.reshape(x, (*x.shape[:axis], 1, *x.shape[axis:])) for x in inputs]
    return graph.node("Concat", parts, result_of(equation), axis=axis)


def _split(graph: "Graph", equation: Any, inputs: list["Value"]) -> list["Tensor"]:
    (x,), params = whole_inputs(graph, equation, inputs), equation.params
    results = [(v.aval.shape, v.aval.dtype) for v in equation.outvars]
    sizes = np.array(params["sizes"], np.int64)
    return graph.nodes("Split", [x, sizes], results, axis=params["axis"])


def _unstack(graph: "Graph", equation: Any, inputs: list["Value"]) -> list["Value"]:
    (x,), axis = whole_inputs(graph, equation, inputs), equation.params["axis"]
    results = [(v.aval.shape, v.aval.dtype) for v in equation.outvars]
    sizes = np.ones(len(results), np.int64)
    slices = [((*s[:axis], 1, *s[axis:]), dtype) for s, dtype in results]
    parts = graph.nodes("Split", [x, sizes], slices, axis=axis)
    return [graph.reshape(p, s) for p, (s, _) in zip(parts, results, strict=True)]


def _iota(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    shape, axis = equation.params["shape"], equation.params["dimension"]
    size = graph.reshape(graph.dim(shape[axis]), ())
    zero, one = np.array(0, np.int64), np.array(1, np.int64)
    numbers = graph.node("Range", [zero, size, one], ((shape[axis],), np.int64))
    aligned = [d if i == axis else 1 for i, d in enumerate(shape)]
    return graph.cast(graph.reshape(numbers, aligned), result_of(equation)[1])


def _dim_as_value(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    size = graph.reshape(graph.dim(equation.params["dim"]), ())
    return graph.cast(size, result_of(equation)[1])


def _reduction(kind: str) -> Callable[..., "Value"]:
    def add(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
        (x,), (shape, dtype) = (
            whole_inputs(graph, equation, inputs),
            result_of(equation),
        )
        logical = x.dtype == bool  # `kind` is a maximum or minimum then
        x = graph.cast(x, np.int32) if logical else x
        axes = np.array(equation.params["axes"], np.int64)
        value = graph.node(kind, [x, axes], (shape, x.dtype), keepdims=0)
        return graph.cast(value, dtype)

    return add


def _argmax(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    (x,), (shape, dtype) = whole_inputs(graph, equation, inputs), result_of(equation)
    x = graph.cast(x, np.int32) if x.dtype == bool else x
    (axis,) = equation.params["axes"]
    value = graph.node("ArgMax", [x], (shape, np.int64), axis=axis, keepdims=0)
    return graph.cast(value, dtype)


def _product(dims: Sequence[Any]) -> Any:
    return functools.reduce(lambda a, b: a * b, dims, 1)


def _dot_general(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    left, right = whole_inputs(graph, equation, inputs)
    contracted, batch = equation.params["dimension_numbers"]
    shape, dtype = result_of(equation)
    free = [
        [i for i in range(len(x.shape)) if i not in c and i not in b]
        for x, c, b in zip((left, right), contracted, batch, strict=True)
    ]
    left = graph.transpose(left, [*batch[0], *free[0], *contracted[0]])
    right = graph.transpose(right, [*batch[1], *contracted[1], *free[1]])
    count = len(batch[0])
    if not (count == 0 and len(contracted[0]) == len(free[1]) == 1 and free[0]):
        # As matrices, one for each place of the batch.
        cut = count + len(free[0])
        rows, inner = left.shape[count:cut], left.shape[cut:]
        columns = right.shape[count + len(contracted[1]) :]
        head = tuple(left.shape[:count])
        left = graph.reshape(left, (*head, _product(rows), _product(inner)))
        right = graph.reshape(right, (*head, _product(inner), _product(columns)))
    product = (*left.shape[:-1], right.shape[-1])
    value = graph.node("MatMul", [left, right], (product, left.dtype))
    return graph.cast(graph.reshape(value, shape), dtype)


def _convolution(graph: "Graph", equation: Any, inputs: list["Value"]) -> "Value":
    x, kernel = whole_inputs(graph, equation, inputs)
    params, (shape, dtype) = equation.params, result_of(equation)
    numbers = params["dimension_numbers"]
    if any(d != 1 for d in params["lhs_dilation"]):
        raise NotImplementedError("no ONNX operator is known for dilated inputs")
    before, after = zip(*params["padding"], strict=True)
    value = graph.node(
        "Conv",
        [
            graph.transpose(x, numbers.lhs_spec),
            graph.transpose(kernel, numbers.rhs_spec),
        ],
        ([shape[i] for i in numbers.out_spec], dtype),
        strides=list(params["window_strides"]),
        pads=[*before, *after],
        dilations=list(params["rhs_dilation"]),
        group=params["feature_group_count"],
    )
    return graph.transpose(value, np.argsort(numbers.out_spec).tolist())


# Primitives on elements, and the operators that make each.
_ELEMENTS = (
    "add:Add add_any:Add sub:Sub mul:Mul div:Div max:Max min:Min pow:Pow eq:Equal "
    "ne:Equal:Not lt:Less le:LessOrEqual gt:Greater ge:GreaterOrEqual and:And or:Or "
    "not:Not neg:Neg abs:Abs sign:Sign exp:Exp log:Log sqrt:Sqrt tanh:Tanh erf:Erf "
    "rsqrt:Sqrt:Reciprocal sin:Sin cos:Cos floor:Floor logistic:Sigmoid"
)
OPERATORS: dict[str, Callable[..., Any]] = {}
for _entry in _ELEMENTS.split():
    _primitive, *_kinds = _entry.split(":")
    OPERATORS[_primitive] = _elements(*_kinds)
for _primitive in ("stop_gradient", "copy", "copy_p", "optimization_barrier"):
    OPERATORS[_primitive] = _same
OPERATORS |= {"convert_element_type": _convert, "square": _square, "rem": _remainder}
OPERATORS |= {"integer_pow": _integer_pow, "is_finite": _is_finite, "select_n": _select}
OPERATORS |= {"clamp": _clamp, "reshape": _reshape, "squeeze": _squeeze, "rev": reverse}
OPERATORS |= {"expand_dims": _expand_dims, "transpose": _transpose, "slice": cut}
OPERATORS |= {"broadcast_in_dim": _broadcast_in_dim, "pad": pad, "split": _split}
OPERATORS |= {"concatenate": _concatenate, "stack": _stack, "iota": _iota}
OPERATORS["unstack"] = _unstack
OPERATORS |= {"dim_as_value": _dim_as_value, "argmax": _argmax, "gather": gather}
OPERATORS |= {"reduce_sum": _reduction("ReduceSum"), "dot_general": _dot_general}
OPERATORS |= dict.fromkeys(("reduce_max", "reduce_or"), _reduction("ReduceMax"))
OPERATORS |= dict.fromkeys(("reduce_min", "reduce_and"), _reduction("ReduceMin"))
OPERATORS["conv_general_dilated"] = _convolution
