"""Programs kept between runs; how many compilations an estimate takes."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from small_networks import SHALLOW_OURS, lively_network

from unips_jax.estimation import programs, streaming
from unips_jax.estimation.programs import kept
from unips_jax.estimation.streaming import estimate_photographs

X = np.arange(3, dtype=np.float32)


@pytest.fixture
def traced(tmp_path):
    """A function whose traces are counted, and the folder of kept programs."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "cache"))
    count = []

    def double(pair, *, more=0):
        count.append(more)
        return pair[0] * 2 + more, pair[1].sum()

    yield double, count, tmp_path / "cache" / "programs"
    jax.config.update("jax_compilation_cache_dir", before)


def call(function, x=X, **static):
    """As in a new process."""
    result = kept(function)((x, x), **static)
    np.testing.assert_array_equal(result[0], x * 2 + static.get("more", 0))
    assert result[1] == x.sum()


def test_nothing_is_traced_twice(traced):
    double, count, folder = traced
    for _ in range(3):
        call(double)
    assert len(count) == 1
    assert folder.stat().st_mode & 0o77 == 0
    for change in ({"x": X[:2]}, {"x": X.astype(np.int32)}, {"more": 5}):
        call(double, **change)
        call(double, **change)
    assert count == [0, 0, 0, 5]
    assert len(list(folder.iterdir())) == 4


def test_a_bucket_is_no_folder_here(traced):
    assert programs._place("double").parent == traced[2]
    jax.config.update("jax_compilation_cache_dir", "gs://bucket/cache")
    assert programs._place("double") is None


@pytest.mark.parametrize(
    ("platform", "version", "expected"),
    [("cpu", "", "cpu"), ("tpu", "", "tpu"), ("gpu", "cuda 13010", "cuda")]
    + [("gpu", "PJRT C API\nrocm 70000", "rocm")],
)
def test_programs_are_for_the_device_that_was_chosen(platform, version, expected):
    """Whatever the default backend is."""
    client = SimpleNamespace(platform_version=version)
    device = SimpleNamespace(platform=platform, client=client)
    assert programs._export_platform(device) == expected


def test_other_functions_and_other_code_are_apart(traced, monkeypatch):
    """Of equal shapes: a function's name and its code are part of the key."""
    double, count, _ = traced

    def triple(pair):
        return pair[0] * 3, pair[1].sum()

    call(double)
    assert kept(triple)((X, X))[0][2] == 6
    monkeypatch.setattr(programs, "_code", lambda: "changed")
    call(double)
    assert len(count) == 2


@pytest.mark.parametrize("data", [b"", b"\0" * 10, b"\0" * 999, None])
def test_damaged_programs_are_made_anew(traced, data):
    double, count, folder = traced
    call(double)
    (file,) = folder.iterdir()
    good = file.read_bytes()
    file.write_bytes(good[:-1] + b"?" if data is None else data)
    call(double)
    call(double)  # what was written instead is good
    assert len(count) == 2


def test_few_are_kept(traced, monkeypatch):
    double, _, folder = traced
    monkeypatch.setattr(programs, "_MOST", 3)
    for more in range(5):
        call(double, more=more)
    assert len(list(folder.iterdir())) == 3


def test_without_a_folder_nothing_is_kept(traced):
    double, count, folder = traced
    jax.config.update("jax_compilation_cache_dir", None)
    call(double)
    call(double)
    assert len(count) == 2 and not folder.exists()


def disc(size, count=3):
    y, x = np.mgrid[-1 : 1 : size * 1j, -1 : 1 : size * 1j]
    images = np.random.default_rng(0).random((count, size, size, 3), np.float32)
    return images, x**2 + y**2 < 0.8


def test_an_estimate_compiles_two_programs():
    """Whatever the photographs' size: nothing else of it runs in JAX."""
    network, compiled = lively_network(SHALLOW_OURS), []

    def listen(event, *_, **__):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        estimate_photographs(network, *disc(37, count=9))  # as no other test has
        assert len(compiled) == 2
        estimate_photographs(network, *disc(41, count=9))
        assert len(compiled) == 2
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def test_fast_is_nearly_the_same_with_the_mirrored_view_at_few_pixels(monkeypatch):
    network = lively_network(SHALLOW_OURS)
    images, mask = disc(240)
    # Photographs are smooth: so is what the mirrored view changes.
    coarse = np.linspace(0, 1, 240, dtype=np.float32)
    images = 0.2 + images[:, :1, :1] * coarse[:, None, None] * coarse[None, :, None]
    views = []
    find = streaming._decode.compiled

    def compiled(*example):
        decode = find(*example)

        def counted(network, encoding, *rest):
            views.append(len(encoding.contexts) * rest[1][0].size)
            return decode(network, encoding, *rest)

        return counted

    monkeypatch.setattr(streaming, "_decode", SimpleNamespace(compiled=compiled))
    whole = estimate_photographs(network, images, mask)
    all_pixels = sum(views)
    views.clear()
    fast = estimate_photographs(network, images, mask, fast=True)
    assert sum(views) < 0.7 * all_pixels
    monkeypatch.setattr(streaming, "_STRIP", 1)  # in several strips of rows
    strips = estimate_photographs(network, images, mask, fast=True)
    np.testing.assert_array_equal(strips, fast)
    np.testing.assert_allclose(np.linalg.norm(fast, axis=-1), mask, atol=1e-5)

    cosine = (fast * whole).sum(-1)[mask]
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 1


def test_errors_of_a_thread_are_raised(monkeypatch):
    def broken(*_):
        raise MemoryError("no memory for this chunk")

    kept = SimpleNamespace(compiled=lambda *_: broken)
    monkeypatch.setattr(streaming, "_decode", kept)
    with pytest.raises(MemoryError, match="this chunk"):
        estimate_photographs(lively_network(SHALLOW_OURS), *disc(37))


MESHES = """
import sys
import jax
import numpy as np
from small_networks import SHALLOW_OURS, lively_network
from unips_jax.estimation.streaming import estimate_photographs

jax.config.update("jax_compilation_cache_dir", sys.argv[1])
images = np.random.default_rng(0).random((2, 32, 32, 3), np.float32)
network = lively_network(SHALLOW_OURS)
kinds = [jax.sharding.AxisType.Explicit] * (len(jax.devices()) > 1)
for kind in kinds:
    mesh = jax.make_mesh((2,), ("data",), axis_types=(kind,))
    with jax.set_mesh(mesh):
        within = estimate_photographs(network, images)
with jax.disable_jit(not kinds):
    found = estimate_photographs(network, images)
for _ in kinds:
    np.testing.assert_array_equal(within, found)
print(len(jax.devices()), float(np.linalg.norm(found)))
"""


def test_a_callers_mesh_is_not_kept(tmp_path):
    """Programs are of one device, in this process and in later ones."""
    said = []
    for devices in (2, 1):
        flags = os.environ.get("XLA_FLAGS", "")
        flags += f" --xla_force_host_platform_device_count={devices}"
        path = os.pathsep.join(map(str, (*sys.path, Path(__file__).parents[1])))
        environment = {**os.environ, "XLA_FLAGS": flags, "PYTHONPATH": path}
        ran = subprocess.run(
            [sys.executable, "-c", MESHES, str(tmp_path)],
            env=environment,
            capture_output=True,
            text=True,
        )
        assert ran.returncode == 0, ran.stderr
        said.append(ran.stdout.split())
    assert [count for count, _ in said] == ["2", "1"] and said[0][1] == said[1][1]
