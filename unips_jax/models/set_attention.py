"""Attention over sets: SAB and PMA of the Set Transformer (Lee et al., 2019).

Two arithmetics, chosen by `UniPSConfig.attention`:

- "pre_norm", the paper's standard Transformer layer: X + attention(LN(X)), scale
  sqrt(width of a head), then X + MLP(LN(X)). Keys come from the normalised set. Where
  widths differ, the residual passes a learned projection.
- "released", what the authors' network computes: LayerNorm on the query path only (or
  nowhere), logits divided by sqrt of the *full* width, and the *projected query* as
  the residual.

Sets may be padded: `valid` marks the members, and padding never changes a result.
"""

from collections.abc import Callable
from typing import Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike, DTypeLike

from unips_jax.models import ops

AttentionKind = Literal["pre_norm", "released"]


def truncated_normal(stddev: float = 0.02) -> nn.initializers.Initializer:
    """The initialiser of all linear layers: normal, cut at two standard deviations."""
    return nn.initializers.truncated_normal(stddev)


class Dense(nn.Dense):
    """A linear layer on one matrix: on CPU the kernel's gradient is twice as fast."""

    def __call__(self, x: Array) -> Array:
        """Maps `[..., C]` to `[..., features]`."""
        y = super().__call__(x.reshape(-1, x.shape[-1]))
        return y.reshape(*x.shape[:-1], self.features)


def dense(
    features: int, dtype: DTypeLike, name: str | None = None, *, use_bias: bool = True
) -> Dense:
    """A linear layer with the network's initialisation."""
    initial = truncated_normal()
    return Dense(features, use_bias, dtype=dtype, kernel_init=initial, name=name)


def layer_norm(dtype: DTypeLike, name: str | None = None) -> nn.LayerNorm:
    """LayerNorm over channels, epsilon 1e-5, statistics in float32."""
    return nn.LayerNorm(epsilon=1e-5, dtype=dtype, name=name)


def dot_product_attention(
    q: Array,
    k: Array,
    v: Array,
    *,
    num_heads: int,
    scale: float,
    bias: ArrayLike = 0.0,
    dropout: Callable[[Array], Array] = lambda weights: weights,
) -> Array:
    """Attention of `q [..., Q, C]` to `k, v [..., N, C]`; softmax at least in float32.

    Each head has C / heads channels in a row. `bias [..., heads, Q, N]` is added to the
    logits after `scale`; `dropout` is applied to the weights.
    """

    def split(x: Array) -> Array:
        x = x.reshape(*x.shape[:-1], num_heads, x.shape[-1] // num_heads)
        # Heads become a batch of contiguous small products: on CPU the backward pass
        # is several times faster than that of any other order or of plain sums.
        return jnp.swapaxes(x, -2, -3)  # [..., heads, N, D]

    q, k, v = split(q), split(k), split(v)
    wide = ops.wide_dtype(q.dtype)
    logits = jnp.matmul(q, jnp.swapaxes(k, -1, -2), preferred_element_type=wide)
    bias = jnp.asarray(bias, wide)
    logits = logits * scale + ops.leading(bias, logits.ndim)
    if ops.known(lambda: k.shape[-2] <= k.shape[-1]):
        weights = dropout(jax.nn.softmax(logits, axis=-1))
        attended = jnp.matmul(weights.astype(v.dtype), v)
    else:
        # What is smaller than the weights is divided by their sum: on CPU attention
        # takes two thirds of the time, forward and backward.
        top = jax.lax.stop_gradient(jnp.max(logits, axis=-1, keepdims=True))
        weights = jnp.exp(logits - top)
        total = jnp.sum(weights, axis=-1, keepdims=True)
        weights = dropout(weights).astype(v.dtype)
        attended = jnp.matmul(weights, v, preferred_element_type=wide) / total
    attended = jnp.swapaxes(attended.astype(v.dtype), -2, -3)
    return attended.reshape(*attended.shape[:-2], -1)


def members_bias(valid: Array | None) -> ArrayLike:
    """Bias that hides the members of a set that do not count; `[N]` or 0."""
    return 0.0 if valid is None else jnp.where(valid, 0.0, -jnp.inf)


class SetMLP(nn.Module):
    """The residual MLP that ends every block: x + W2 gelu(W1 LN(x))."""

    mlp_dim: int
    use_layer_norm: bool
    dropout_rate: float  # on the hidden layer and on the branch
    dtype: DTypeLike

    @nn.compact
    def __call__(self, x: Array, deterministic: bool) -> Array:
        dropout = nn.Dropout(self.dropout_rate)
        hidden = layer_norm(self.dtype, "norm")(x) if self.use_layer_norm else x
        hidden = dense(self.mlp_dim, self.dtype, "fc1")(hidden)
        hidden = dropout(ops.gelu(hidden), deterministic)
        hidden = dense(x.shape[-1], self.dtype, "fc2")(hidden)
        return x + dropout(hidden, deterministic)


class SAB(nn.Module):
    """Set attention block: every member of a set reads from all of them."""

    features: int
    num_heads: int
    mlp_dim: int
    attention: AttentionKind
    use_layer_norm: bool = True  # "released" only; "pre_norm" always normalises
    dropout_rate: float = 0.0  # on attention weights, in the MLP, on its branch
    # Of more than twice as many members, this many attend at a time, so that the
    # weights stay in cache; not with dropout.
    query_chunk: int | None = None
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(self, x: Array, valid: Array | None, deterministic: bool) -> Array:
        """Sets `[..., N, C]` to `[..., N, features]`; `valid [N]`: the members."""
        pre_norm = self.attention == "pre_norm"
        layer_norms = pre_norm or self.use_layer_norm
        normed = layer_norm(self.dtype, "norm")(x) if layer_norms else x
        keys = normed if pre_norm else x
        q = dense(self.features, self.dtype, "query")(normed)
        k = dense(self.features, self.dtype, "key")(keys)
        v = dense(self.features, self.dtype, "value")(keys)

        dropout = nn.Dropout(self.dropout_rate)
        width = self.features // self.num_heads if pre_norm else self.features

        def attend(q: Array) -> Array:
            return dot_product_attention(
                q,
                k,
                v,
                num_heads=self.num_heads,
                scale=width**-0.5,
                bias=members_bias(valid),
                dropout=lambda weights: dropout(weights, deterministic),
            )

        chunk = self.query_chunk
        if chunk and deterministic and ops.known(lambda: q.shape[-2] > 2 * chunk):
            attended = _by_queries(attend, q, chunk)
        else:
            attended = attend(q)
        if pre_norm:
            attended = dense(self.features, self.dtype, "out")(attended)
            if x.shape[-1] != self.features:
                x = dense(self.features, self.dtype, "residual")(x)
            x = x + attended
        else:
            x = q + attended
        mlp = SetMLP(
            self.mlp_dim, layer_norms, self.dropout_rate, self.dtype, name="mlp"
        )
        return mlp(x, deterministic)


def _by_queries(attend: Callable[[Array], Array], q: Array, size: int) -> Array:
    """Attention of queries `[..., Q, C]`, `size` of them at a time."""
    count = q.shape[-2]
    chunks = -(-count // size)
    q = jnp.pad(q, [(0, 0)] * (q.ndim - 2) + [(0, chunks * size - count), (0, 0)])
    parts = q.reshape(*q.shape[:-2], chunks, size, q.shape[-1])
    done = jax.lax.map(jax.checkpoint(attend), jnp.moveaxis(parts, -3, 0))
    return jnp.moveaxis(done, 0, -3).reshape(q.shape)[..., :count, :]


class _Linear(nn.Module):
    """The parameters of a linear layer, for arithmetic that reorders its product."""

    features: int

    @nn.compact
    def __call__(self, in_features: int) -> tuple[Array, Array]:
        shape = (in_features, self.features)
        kernel = self.param("kernel", truncated_normal(), shape, jnp.float32)
        zeros = nn.initializers.zeros
        return kernel, self.param("bias", zeros, (self.features,), jnp.float32)


class PMA(nn.Module):
    """Pooling by multihead attention: learned seeds read from a set.

    The queries are the same for every set. So they are folded into the key projection
    (its bias drops out of the softmax), and values are projected after pooling: the
    result is that of the plain block, with one product per set in place of two per
    member.
    """

    features: int
    num_heads: int
    mlp_dim: int
    attention: AttentionKind  # "released" has no LayerNorm
    num_seeds: int = 1
    dropout_rate: float = 0.0
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(self, y: Array, valid: Array | None, deterministic: bool) -> Array:
        """Sets `[..., N, C]` to `[..., num_seeds, features]`; `valid [N]`: members."""
        pre_norm = self.attention == "pre_norm"
        seeds = self.param(
            "seeds",
            nn.initializers.xavier_uniform(),
            (self.num_seeds, self.features),
            jnp.float32,
        )
        seeds = jnp.asarray(seeds, self.dtype)
        queries = seeds
        if pre_norm:
            queries = layer_norm(self.dtype, "norm")(seeds)
            y = layer_norm(self.dtype, "norm_set")(y)
        q = dense(self.features, self.dtype, "query")(queries)  # [seeds, features]
        attended = self._attend(q, y, valid, deterministic)
        if pre_norm:
            attended = dense(self.features, self.dtype, "out")(attended)
        residual = seeds if pre_norm else q
        x = ops.leading(residual, attended.ndim) + attended
        mlp = SetMLP(self.mlp_dim, pre_norm, self.dropout_rate, self.dtype, name="mlp")
        return mlp(x, deterministic)

    def _attend(
        self, q: Array, y: Array, valid: Array | None, deterministic: bool
    ) -> Array:
        c, heads, head_dim = (
            y.shape[-1],
            self.num_heads,
            self.features // self.num_heads,
        )
        key_kernel, _ = _Linear(self.features, name="key")(c)
        value_kernel, value_bias = _Linear(self.features, name="value")(c)
        key_kernel = key_kernel.reshape(c, heads, head_dim).astype(self.dtype)
        value_kernel = value_kernel.reshape(c, heads, head_dim).astype(self.dtype)

        width = head_dim if self.attention == "pre_norm" else self.features
        folded = jnp.einsum("shd,chd->csh", q.reshape(-1, heads, head_dim), key_kernel)
        logits = jnp.tensordot(y, folded * width**-0.5, 1)  # [..., N, seeds, heads]
        logits = logits.astype(ops.wide_dtype(logits.dtype))
        if valid is not None:
            members = ops.leading(valid[:, None, None], logits.ndim)
            logits = jnp.where(members, logits, -jnp.inf)
        weights = jax.nn.softmax(logits, axis=-3)
        weights = nn.Dropout(self.dropout_rate)(weights, deterministic).astype(y.dtype)

        # One mixture of members per seed and head, then each head's values from it
        mixing = weights.reshape(*weights.shape[:-2], -1)  # [..., N, seeds * heads]
        mixed = jnp.matmul(jnp.swapaxes(mixing, -1, -2), y)
        mixed = mixed.reshape(*mixed.shape[:-2], -1, heads, c)
        attended = jnp.einsum("...shc,chd->...shd", mixed, value_kernel)
        total = jnp.sum(weights, axis=-3)[..., None]  # 1 without dropout
        wide = ops.wide_dtype(self.dtype)
        bias = value_bias.astype(wide).reshape(heads, head_dim)
        bias = total.astype(wide) * ops.leading(bias, total.ndim)
        attended = attended.astype(wide) + bias
        return attended.reshape(*attended.shape[:-2], self.features).astype(y.dtype)
