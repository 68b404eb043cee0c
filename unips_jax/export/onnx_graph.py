"""A traced function as an ONNX graph.

The equations of a jaxpr become nodes one by one (`onnx_operators`), the functions they
call are written out. Parameters that half precision holds exactly are stored so.

Dimensions may be symbols (`jax.export.symbolic_shape`). A broadcast is put off until
something needs it: ONNX operators on elements broadcast by themselves.

The package `jax2onnx` does the same for all of JAX. It is not used, as it cannot be
installed with the orbax that training needs.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx
from jax.extend import core
from onnx import TensorProto, helper, numpy_helper

from unips_jax.export.onnx_operators import CALLS, OPERATORS

OPSET = 18
_IR_VERSION = 9  # of the file format: onnxruntime 1.17 and later

_TYPES = {
    np.dtype(np.float32): TensorProto.FLOAT,
    np.dtype(np.float64): TensorProto.DOUBLE,
    np.dtype(np.int32): TensorProto.INT32,
    np.dtype(np.int64): TensorProto.INT64,
    np.dtype(bool): TensorProto.BOOL,
}


@dataclasses.dataclass(frozen=True)
class Tensor:
    """A value of the graph."""

    name: str  # in the graph
    shape: tuple[Any, ...]  # what it has there; 1 where a broadcast was put off
    dtype: np.dtype  # of its elements


Value = Tensor | np.ndarray


class Graph:
    """A graph that grows node by node."""

    def __init__(self) -> None:
        self._nodes: list[onnx.NodeProto] = []
        self._constants: dict[tuple[Any, ...], str] = {}
        self._initializers: list[onnx.TensorProto] = []
        self._inputs: list[onnx.ValueInfoProto] = []
        self._symbols: dict[str, Tensor] = {}
        self._count = 0

    def input(self, name: str, aval: Any) -> Tensor:
        """Adds an input; the shape of `aval` may hold symbols."""
        tensor = Tensor(name, tuple(aval.shape), np.dtype(aval.dtype))
        self._inputs.append(_value_info(tensor))
        for axis, dim in enumerate(tensor.shape):
            if not isinstance(dim, int) and str(dim) not in self._symbols:
                size = self.node(
                    "Shape", [tensor], ((1,), np.int64), start=axis, end=axis + 1
                )
                self._symbols[str(dim)] = size
        return tensor

    def node(
        self, kind: str, inputs: Sequence[Value], result: Any, **attributes: Any
    ) -> Tensor:
        """Adds the ONNX operator `kind`, whose one output is shaped as `result`."""
        shape, dtype = result
        (tensor,) = self.nodes(kind, inputs, [(shape, dtype)], **attributes)
        return tensor

    def nodes(
        self,
        kind: str,
        inputs: Sequence[Value],
        results: Sequence[tuple[Sequence[Any], Any]],
        **attributes: Any,
    ) -> list[Tensor]:
        """Adds a node of several outputs; arguments as of `node`."""
        tensors = []
        for shape, dtype in results:
            self._count += 1
            tensors.append(Tensor(f"v{self._count}", tuple(shape), np.dtype(dtype)))
        names = [self.name_of(value) for value in inputs]
        outputs = [tensor.name for tensor in tensors]
        self._nodes.append(helper.make_node(kind, names, outputs, **attributes))
        return tensors

    def name_of(self, value: Value) -> str:
        """The name of a value in the graph; constants become initializers."""
        if isinstance(value, Tensor):
            return value.name
        value = np.asarray(value)
        key = (value.dtype.str, value.shape, value.tobytes())
        if key not in self._constants:
            name = f"c{len(self._constants)}"
            self._constants[key] = name
            half = value.astype(np.float16) if value.dtype == np.float32 else None
            if half is not None and value.size > 64 and _same(half, value):
                stored = numpy_helper.from_array(half, f"{name}_half")
                cast = helper.make_node(
                    "Cast", [stored.name], [name], to=TensorProto.FLOAT
                )
                self._nodes.append(cast)
            else:
                stored = numpy_helper.from_array(value, name)
            self._initializers.append(stored)
        return self._constants[key]

    def dims(self, shape: Sequence[Any]) -> Value:
        """A shape as an int64 tensor `[rank]`."""
        if all(isinstance(dim, int) for dim in shape):
            return np.array(shape, np.int64)
        parts = [self.dim(dim) for dim in shape]
        return self.node("Concat", parts, ((len(parts),), np.int64), axis=0)

    def dim(self, dim: Any) -> Value:
        """A dimension as an int64 tensor `[1]`."""
        if isinstance(dim, int):
            return np.array([dim], np.int64)
        # A symbolic dimension's text is an expression that `symbolic_shape` reads.
        known = {name: _Dim(self, size) for name, size in self._symbols.items()}
        text = str(dim).replace("^", "**")
        found = eval(text, {"__builtins__": {}}, known)
        return found.value if isinstance(found, _Dim) else np.array([found], np.int64)

    def reshape(self, value: Value, shape: Sequence[Any]) -> Value:
        """Reshapes; no broadcast may be put off."""
        shape = tuple(shape)
        if tuple(value.shape) == shape:
            return value
        if isinstance(value, np.ndarray):
            return value.reshape(shape)
        unknown = [axis for axis, dim in enumerate(shape) if not isinstance(dim, int)]
        if len(unknown) == 1:
            sizes: Value = np.array(
                [dim if isinstance(dim, int) else -1 for dim in shape], np.int64
            )
        else:
            sizes = self.dims(shape)
        return self.node("Reshape", [value, sizes], (shape, value.dtype))

    def transpose(self, value: Value, order: Sequence[int]) -> Value:
        """Reorders axes."""
        order = list(order)
        if order == sorted(order):
            return value
        if isinstance(value, np.ndarray):
            return np.ascontiguousarray(value.transpose(order))
        shape = [value.shape[i] for i in order]
        return self.node("Transpose", [value], (shape, value.dtype), perm=order)

    def cast(self, value: Value, dtype: Any) -> Value:
        """Changes the type."""
        dtype = np.dtype(dtype)
        if value.dtype == dtype:
            return value
        if isinstance(value, np.ndarray):
            return value.astype(dtype)
        return self.node("Cast", [value], (value.shape, dtype), to=_TYPES[dtype])

    def whole(self, value: Value, shape: Sequence[Any]) -> Value:
        """Does the broadcast that was put off."""
        if tuple(value.shape) == tuple(shape):
            return value
        if isinstance(value, np.ndarray) and all(isinstance(d, int) for d in shape):
            return np.broadcast_to(value, tuple(shape))
        return self.node("Expand", [value, self.dims(shape)], (shape, value.dtype))

    def add_jaxpr(
        self,
        jaxpr: Any,
        consts: Sequence[Any],
        args: Sequence[Value],
        wanted: Sequence[bool] | None = None,
    ) -> list[Any]:
        """Adds the equations of an open jaxpr; returns the values of its results.

        Of results that are not `wanted` None, and nothing that serves only them.
        """
        values: dict[Any, Value] = {}

        def read(atom: Any) -> Value:
            if isinstance(atom, core.Literal):
                aval: Any = atom.aval
                return np.asarray(atom.val, aval.dtype)
            return values[atom]

        for variable, const in zip(jaxpr.constvars, consts, strict=True):
            values[variable] = np.asarray(const)
        values.update(zip(jaxpr.invars, args, strict=True))
        wanted = wanted or [True] * len(jaxpr.outvars)
        for equation, used in _needed(jaxpr, wanted):
            inputs = [read(atom) for atom in equation.invars]
            found = self._add(equation, inputs, used)
            values.update(zip(equation.outvars, found, strict=True))
        results = zip(jaxpr.outvars, wanted, strict=True)
        return [read(atom) if want else None for atom, want in results]

    def _add(
        self, equation: Any, inputs: list[Value], used: Sequence[bool]
    ) -> Sequence[Any]:
        name, params = equation.primitive.name, equation.params
        if name in CALLS:
            called = params[CALLS[name]]
            inner = (
                called if hasattr(called, "consts") else core.ClosedJaxpr(called, ())
            )
            return self.add_jaxpr(inner.jaxpr, inner.consts, inputs, used)
        if _is_constant(equation, inputs):
            avals = [atom.aval for atom in equation.invars]
            whole = [self.whole(x, a.shape) for x, a in zip(inputs, avals, strict=True)]
            found = equation.primitive.bind(*whole, **params)
            found = found if equation.primitive.multiple_results else [found]
            return [np.asarray(x) for x in found]
        if name not in OPERATORS:
            raise NotImplementedError(
                f"no ONNX operator is known for JAX's {name}; add it to "
                "unips_jax.export.onnx_operators"
            )
        found = OPERATORS[name](self, equation, inputs)
        return found if isinstance(found, list) else [found]

    def model(
        self, outputs: dict[str, Value], name: str, metadata: dict[str, str]
    ) -> onnx.ModelProto:
        """The model, with its outputs by their names."""
        infos = []
        for key, value in outputs.items():
            self._nodes.append(
                helper.make_node("Identity", [self.name_of(value)], [key])
            )
            infos.append(_value_info(Tensor(key, tuple(value.shape), value.dtype)))
        graph = helper.make_graph(
            self._nodes, name, self._inputs, infos, self._initializers
        )
        model = helper.make_model(
            graph,
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=_IR_VERSION,
            producer_name="unips_jax",
        )
        helper.set_model_props(model, metadata)
        return model


@dataclasses.dataclass(frozen=True)
class _Dim:
    """A dimension in an expression: its operators add nodes."""

    graph: Graph
    value: Value

    def _with(self, kind: str, other: Any, *, swapped: bool = False) -> "_Dim":
        number = other.value if isinstance(other, _Dim) else np.array([other], np.int64)
        inputs = [number, self.value] if swapped else [self.value, number]
        return _Dim(self.graph, self.graph.node(kind, inputs, ((1,), np.int64)))

    def __add__(self, other: Any) -> "_Dim":
        return self._with("Add", other)

    def __sub__(self, other: Any) -> "_Dim":
        return self._with("Sub", other)

    def __rsub__(self, other: Any) -> "_Dim":
        return self._with("Sub", other, swapped=True)

    def __mul__(self, other: Any) -> "_Dim":
        return self._with("Mul", other)

    def __pow__(self, power: int) -> "_Dim":
        return self if power == 1 else self * self ** (power - 1)

    def __neg__(self) -> "_Dim":
        return self._with("Mul", -1)

    __radd__, __rmul__ = __add__, __mul__


def _needed(jaxpr: Any, wanted: Sequence[bool]) -> list[tuple[Any, list[bool]]]:
    """The equations that the wanted results follow from, and which outputs are used."""
    pairs = zip(jaxpr.outvars, wanted, strict=True)
    used = {atom for atom, want in pairs if want and isinstance(atom, core.Var)}
    needed = []
    for equation in reversed(jaxpr.eqns):
        outputs = [variable in used for variable in equation.outvars]
        if any(outputs):
            needed.append((equation, outputs))
            used.update(x for x in equation.invars if isinstance(x, core.Var))
    return needed[::-1]


def _is_constant(equation: Any, inputs: list[Value]) -> bool:
    """Whether an equation is computed here: places and shapes, known and not large."""
    # What else follows from parameters alone, onnxruntime computes when it loads a
    # file.
    if equation.primitive.name == "dim_as_value":
        return False
    avals = [variable.aval for variable in equation.outvars]
    return (
        all(isinstance(value, np.ndarray) for value in inputs)
        and all(np.dtype(aval.dtype).kind in "biu" for aval in avals)
        and all(isinstance(dim, int) for aval in avals for dim in aval.shape)
    )


def _same(half: np.ndarray, value: np.ndarray) -> bool:
    with np.errstate(over="ignore"):
        return np.array_equal(half.astype(np.float32), value)


def _value_info(tensor: Tensor) -> onnx.ValueInfoProto:
    shape = [dim if isinstance(dim, int) else str(dim) for dim in tensor.shape]
    return helper.make_tensor_value_info(tensor.name, _TYPES[tensor.dtype], shape)
