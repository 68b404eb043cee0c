"""The application's processes, and what is done in them."""

import asyncio
import dataclasses
import os
import re
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("starlette", reason="starlette is not installed")
pytest.importorskip("uvicorn", reason="uvicorn is not installed")

from app_client import drawn

from unips_jax.app import work
from unips_jax.app.small_pictures import full_mask, write_preview
from unips_jax.app.worker import Worker
from unips_jax.errors import InputError
from unips_jax.io.images import write_image


def silent(phase, share):
    pass


def allocate(count, *, report):
    report("allocating", 0.5)
    return int(np.ones(count, np.uint8).sum())


def own_process(*, report):
    return os.getpid()


def die(*, report):
    os._exit(9)


def sleep(*, report):
    report("sleeping", 0.0)
    time.sleep(60)


def refuse(*, report):
    raise InputError("expected this,\ngot that")


def with_worker(run, memory=2**31):
    async def whole():
        worker = Worker(memory)
        try:
            return await run(worker)
        finally:
            worker.close()

    return asyncio.run(whole())


def test_a_worker_stays_warm_and_reports():
    said = []

    async def run(worker):
        first = await worker.call(own_process)
        size = await worker.call(allocate, 10**6, report=lambda *r: said.append(r))
        with pytest.raises(InputError, match="expected this, got that"):
            await worker.call(refuse)
        return first, size, await worker.call(own_process)

    first, size, last = with_worker(run)
    assert first == last != os.getpid()
    assert size == 10**6 and said == [("allocating", 0.5)]


def test_what_a_worker_may_not_or_cannot_is_one_line():
    async def run(worker):
        first = await worker.call(own_process)
        with pytest.raises(InputError, match="out of memory"):
            await worker.call(allocate, 3 * 2**30)
        second = await worker.call(own_process)
        with pytest.raises(InputError, match="ended before it was done"):
            await worker.call(die)
        with pytest.raises(InputError, match="within 3 s, got no end"):
            await worker.call(sleep, seconds=3)
        return first, second, await worker.call(own_process)

    processes = with_worker(run)
    assert len({*processes}) == 3  # what failed is not used again


def test_a_call_that_is_cancelled_ends_at_once():
    async def run(worker):
        began = asyncio.Event()
        task = asyncio.create_task(worker.call(sleep, report=lambda *_: began.set()))
        await began.wait()
        start = time.monotonic()
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert time.monotonic() - start < 20
        return await worker.call(own_process)

    assert with_worker(run)


def test_a_drawn_mask_has_the_photographs_size(tmp_path):
    write_image(tmp_path / "a.png", np.full((50, 70, 3), 9, np.uint8))
    (tmp_path / "drawn.png").write_bytes(drawn(40))
    full = full_mask(tmp_path / "drawn.png", tmp_path / "a.png", 10**6)
    assert full.shape == (50, 70) and full.dtype == bool
    assert full.mean() == pytest.approx(20 * 30 / (48 * 64), abs=0.02)
    (tmp_path / "drawn.png").write_bytes(drawn(10))
    with pytest.raises(InputError, match="the mask is empty"):
        full_mask(tmp_path / "drawn.png", tmp_path / "a.png", 10**6)


def test_coarse_normals_are_a_picture(tmp_path):
    normals = np.zeros((3, 5, 3), np.float32)
    normals[1, 2] = 0, 0.6, 0.8
    write_preview(tmp_path / "preview.png", normals)
    picture = cv2.imread(str(tmp_path / "preview.png"), cv2.IMREAD_UNCHANGED)
    assert picture.shape == (3, 5, 4) and picture[..., 3].sum() == 255
    assert picture[1, 2].tolist() == [round(127.5 * 1.8), 204, 128, 255]


def test_a_film_becomes_photographs(tmp_path):
    import tifffile

    pages = np.random.default_rng(0).integers(0, 255, (3, 20, 30, 3), np.uint8)
    with tifffile.TiffWriter(tmp_path / "film.tif") as film:
        for page in pages:
            film.write(page, photometric="rgb", contiguous=False)
    tifffile.imwrite(tmp_path / "one.tif", pages[0], photometric="rgb")
    found = work.look(tmp_path / "film.tif", tmp_path / "t.jpg", 10**6, report=silent)
    assert found == {"frames": [f"film_page_{n:03}.tif" for n in (1, 2, 3)]}
    assert (tmp_path / "film_page_003.tif").exists()
    facts = work.look(tmp_path / "one.tif", tmp_path / "t.jpg", 10**6, report=silent)
    assert (facts["width"], facts["height"]) == (30, 20)
    assert (tmp_path / "t.jpg").exists()


def test_the_pages_options_are_those_of_the_server():
    page = (Path(work.__file__).parent / "assets" / "index.html").read_text("utf-8")
    names = [field.name for field in dataclasses.fields(work.Choices)]
    assert sorted(re.findall(r'data-option="(\w+)"', page)) == sorted(names)


def test_choices_become_the_commands_options(tmp_path, monkeypatch):
    seen = []

    def estimate(folder, target, network, options, **_):
        seen.append(options)
        return {"findings": []}

    monkeypatch.setattr(work, "_network", lambda weights: None)
    monkeypatch.setattr("unips_jax.estimation.folders.estimate_folder", estimate)
    chosen = work.Chosen(tmp_path, ("a.png",), None, ("b.png",))
    asked = work.Choices(
        transfer="srgb", perspective=True, register=True, mesh=False, fast=True
    )
    for mask, choices in (("auto", asked), ("none", work.Choices())):
        places = tmp_path / "out", mask, tmp_path / "preview.png"
        work.estimate(chosen, *places, choices, "tiny", 10**6, report=silent)
    own, plain = seen
    assert (own.transfer, own.focal, own.mesh) == ("srgb", "exif", None)
    assert own.register and own.fast and own.depth and own.view
    assert (own.include, own.exclude) == (("a.png",), ("b.png",))
    assert (plain.focal, plain.mesh, plain.mask) == (None, "glb", "none")
