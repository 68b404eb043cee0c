"""Programs kept between runs, so that nothing is traced a second time.

JAX keeps what it compiled, but traces a function anew in every process, which takes
longer than running it. A traced program is kept here next to the compilations, as
`jax.export` writes it: data that is read, never code that runs when it is read.

A program is found by its function, the code that it follows from, shapes and types, the
network's configuration, JAX's version and flags. What is damaged, or is not this user's
file, is ignored. Programs are kept only where JAX's compilations are
(`console.cache_compilations`).
"""

import contextlib
import functools
import hashlib
import os
import struct
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.export
import numpy as np

from unips_jax.errors import InputError
from unips_jax.io.door import clear_parts, write_whole
from unips_jax.version import __version__

# The most programs that are kept, of half a megabyte each; the oldest go first.
_MOST = 64
# Of JAX's configuration, what changes a program.
_FLAGS = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_default_device",
    "jax_compilation_cache_dir",
)
# Bytes of the sum that a file begins with.
_SUM = 32
_PACKAGE = Path(__file__).parents[1]


class Kept:
    """`jax.jit` of a function of pytrees and static keywords, kept between runs."""

    def __init__(self, find: Callable[..., Any]) -> None:
        self._find = find

    def __call__(self, *arguments: Any, **static: Any) -> tuple[Any, ...]:
        return self.compiled(*arguments, **static)(*arguments)

    def compiled(self, *arguments: Any, **static: Any) -> Callable[..., Any]:
        """The program for arguments of these shapes, by the calling thread's flags."""
        leaves, tree = jax.tree.flatten(arguments)
        shapes = tuple((np.shape(x), np.dtype(x.dtype)) for x in leaves)
        program = self._find(tree, shapes, tuple(sorted(static.items())))

        def run(*arguments: Any) -> tuple[Any, ...]:
            with jax.disable_jit(False):  # there is no other way to run it
                return program(*jax.tree.leaves(arguments))

        return run


def kept(function: Callable[..., tuple[Any, ...]], *, rarely_run: bool = False) -> Kept:
    """Keeps a function's programs.

    `rarely_run`: compiled in three quarters of the time, to a program that is no slower
    as long as products take most of it.
    """
    name = f"{function.__module__}.{function.__qualname__}"
    lock = threading.Lock()

    @functools.cache
    def program(
        tree: Any, shapes: tuple[Any, ...], static: Any, flags: Any
    ) -> Callable[..., Any]:
        arrays = [jax.ShapeDtypeStruct(*shape) for shape in shapes]

        def flat(*leaves: Any) -> tuple[Any, ...]:
            return function(*jax.tree.unflatten(tree, leaves), **dict(static))

        place = _place(name, tree, shapes, static, flags)
        traced = jax.jit(flat)
        if place is not None:
            exported = _read(place)
            if exported is None:
                # By itself it is for the default backend, whatever the device.
                only = _export_platform(default_device())
                exported = jax.export.export(traced, platforms=[only])(*arrays)
                _write(place, exported)
            traced = jax.jit(exported.call)
        chosen = "xla_backend_optimization_level" in os.environ.get("XLA_FLAGS", "")
        less = rarely_run and not chosen and default_device().platform == "cpu"
        options: Any = {"xla_backend_optimization_level": 1} if less else None
        return traced.lower(*arrays).compile(options)

    def find(tree: Any, shapes: tuple[Any, ...], static: Any) -> Callable[..., Any]:
        # Threads wait for one compilation. The caller may be within a mesh; a program's
        # arguments are on one device.
        with lock, jax.set_mesh(_one_device()), jax.disable_jit(False):
            return program(tree, shapes, static, _flags())

    return Kept(find)


def default_device() -> jax.Device:
    """Where arrays are put that nobody placed."""
    chosen = getattr(jax.config, "jax_default_device", None)
    if isinstance(chosen, jax.Device):
        return chosen
    return jax.local_devices(backend=chosen)[0]


def _export_platform(device: jax.Device) -> str:
    """A device's platform as `jax.export` names it: there are two kinds of GPU."""
    if device.platform != "gpu":
        return device.platform
    return "rocm" if "rocm" in device.client.platform_version.lower() else "cuda"


def _one_device() -> jax.sharding.Mesh:
    kind = (jax.sharding.AxisType.Auto,)
    return jax.make_mesh((1,), ("one",), axis_types=kind, devices=[default_device()])


def _place(name: str, *facts: Any) -> Path | None:
    """The file of a program, if there is a folder for it."""
    folder = getattr(jax.config, "jax_compilation_cache_dir", None)
    if not folder or "://" in folder:  # a bucket, which JAX reaches by itself
        return None
    digest = hashlib.blake2b(digest_size=16)
    platform = default_device().platform
    known = (name, *facts, platform, jax.__version__, __version__, _code())
    for fact in known:
        digest.update(f"{fact}\n".encode())
    return Path(folder) / "programs" / f"{digest.hexdigest()}.jax"


def _flags() -> tuple[str, ...]:
    return tuple(str(getattr(jax.config, name, None)) for name in _FLAGS)


@functools.cache
def _code() -> str:
    """A hash of all code that a program may follow from."""
    digest = hashlib.blake2b(digest_size=16)
    files = [*_PACKAGE.glob("models/*.py"), *_PACKAGE.glob("estimation/*.py")]
    for file in sorted(files):
        digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()


def _read(place: Path) -> Any:
    """A kept program, or None: where it is absent, damaged, or another user's."""
    with contextlib.suppress(OSError, ValueError, ImportError, struct.error):
        if hasattr(os, "getuid") and place.stat().st_uid != os.getuid():
            return None
        data = place.read_bytes()
        if hashlib.sha256(data[_SUM:]).digest() == data[:_SUM]:
            os.utime(place)
            return jax.export.deserialize(bytearray(data[_SUM:]))
    return None


def _write(place: Path, exported: Any) -> None:
    """Keeps a program, if that is possible: nothing depends on it."""
    with contextlib.suppress(OSError, InputError, ImportError, ValueError):
        data = bytes(exported.serialize())
        place.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_whole(place, hashlib.sha256(data).digest() + data)
        clear_parts(place.parent)
        files = place.parent.glob("*.jax")
        for file in sorted(files, key=lambda file: file.stat().st_mtime)[:-_MOST]:
            file.unlink(missing_ok=True)
