"""Fixtures that several test files share."""

import contextlib
import gc
import os
from importlib.metadata import version
from pathlib import Path

import pytest

# Tests compile much and compute little. Must be set before JAX starts; subprocesses
# inherit it.
FLAGS = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
if version("jaxlib").startswith("0.10."):  # others may stop at a flag they do not know
    FLAGS += " --xla_cpu_use_fusion_emitters=false"  # a third of the time without
    FLAGS += " --xla_cpu_parallel_codegen_split_count=1"  # an eighth: cores are busy
os.environ.setdefault("XLA_FLAGS", FLAGS)
# GPUs would multiply float32 with 10 bits of mantissa, the golden arrays did not.
os.environ.setdefault("JAX_DEFAULT_MATMUL_PRECISION", "highest")


def pytest_configure(config: pytest.Config) -> None:
    """One compilation serves all test processes, and later runs."""
    if getattr(config, "cache", None) is not None:  # none with `-p no:cacheprovider`
        os.environ.setdefault(
            "JAX_COMPILATION_CACHE_DIR", str(config.cache.mkdir("jax"))
        )
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")


def pytest_collection_finish() -> None:
    """Tracing makes many objects: a sixth of its time were searches for garbage."""
    gc.set_threshold(50_000, 20, 100)


# Those that take longest come first, so that all workers end together.
_FIRST = (
    "test_train_devices.py",
    "test_docs.py",
    "test_train_resume.py",
    "test_browser_page.py",
    "test_browser_page_drops.py",
    "test_app_browser.py",
    "test_app_browser_bad_days.py",
    "test_estimation.py",
    "test_models.py",
    "test_examples.py",
    "test_validation.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    order = {name: place for place, name in enumerate(_FIRST)}
    items.sort(key=lambda item: order.get(item.path.name, len(order)))


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """Large reference data kept next to the repository, or where UNIPS_SHARED says."""
    near = Path(__file__).resolve().parents[2] / "shared"
    path = Path(os.environ.get("UNIPS_SHARED", near))
    if not path.is_dir():
        pytest.skip(f"reference data not found at {path}; set UNIPS_SHARED")
    return path


@pytest.fixture
def network_calls(monkeypatch):
    """Replaces the network: normals lean with the place in the image."""
    import numpy as np

    from unips_jax import weights
    from unips_jax.estimation import streaming
    from unips_jax.models.config import ModelConfig
    from unips_jax.models.network import UniversalNetwork

    calls = []

    def stand_in(network, images, mask, *, progress=None, **options):
        calls.append({"images": images, "mask": mask, **options})
        if progress is not None:
            progress(1, 1)
        y, x = np.mgrid[: mask.shape[0], : mask.shape[1]].astype(np.float32)
        normals = np.stack([x / x.max() - 0.5, 0.5 - y / y.max(), y * 0 + 1], axis=-1)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        return streaming.NormalsAndLights(normals * mask[..., None], None)

    def load(name):
        params = {"a": {"kernel": np.arange(6, dtype=np.float32)}}
        return UniversalNetwork(ModelConfig.tiny(), params)

    monkeypatch.setattr(streaming, "estimate_with_lights", stand_in)
    monkeypatch.setattr(weights, "load_weights", load)
    return calls


@pytest.fixture
def calls(network_calls, monkeypatch):
    """Leaves out the contact sheet, too."""
    from unips_jax.estimation import writing

    monkeypatch.setattr(writing, "write_sheet", lambda *args, **options: None)
    return network_calls


@pytest.fixture(scope="module")
def stand_in(tmp_path_factory):
    """A running application whose network compiles in seconds."""
    import app_page

    with app_page.running_stand_in(tmp_path_factory.mktemp("stand-in")) as there:
        yield there


@pytest.fixture
def opening(tmp_path, monkeypatch):
    """Opens an application that pretends to estimate, again and again on one folder."""
    import app_client

    import unips_jax.app.desk as desk

    monkeypatch.setattr(desk, "Worker", app_client.Pretended)
    monkeypatch.setattr(desk, "_SETTLED_S", 0.05)
    app_client.Pretended.hold.set()
    app_client.Pretended.calls.clear()
    with contextlib.ExitStack() as stack:

        def open_client():
            stack.close()
            served = app_client.served(tmp_path / "results", app_client.LIMITS)
            return stack.enter_context(served)

        open_client.close = stack.close
        yield open_client
