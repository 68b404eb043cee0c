"""The application without a browser: bounds, processes, queue, visitors' files."""

import asyncio
import os
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from unips_jax.app import work
from unips_jax.app.child import Child, Stopped
from unips_jax.app.jobs import Job, Queue
from unips_jax.app.limits import BodyLimit, Limits
from unips_jax.app.visitors import Visitors
from unips_jax.cli.app import main as app
from unips_jax.errors import InputError
from unips_jax.io.images import read_image, write_image

SAMPLE = Path(__file__).parents[2] / "unips_jax/assets/sample/obj000.data"
SMALL = Limits(file_bytes=1000, object_bytes=2500, files=3, objects=2, visitors=2)


def silent(phase, share):
    pass


@pytest.fixture
def visitors():
    visitors = Visitors(SMALL)
    yield visitors
    visitors.close_all()
    assert not visitors.folder.exists()


def allocate(count, *, report):
    report("allocating", 0.5)
    return int(np.ones(count, np.uint8).sum())


def die(*, report):
    os._exit(9)


def sleep(*, report):
    report("sleeping", 0.0)
    time.sleep(60)


def refuse(*, report):
    raise InputError("expected this, got that")


def test_a_child_reports_and_returns():
    told = []

    async def run():
        child = Child(allocate, 10**6, memory=2**30)
        return await child.run(lambda *report: told.append(report))

    assert asyncio.run(run()) == 10**6
    assert told == [("allocating", 0.5)]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ((allocate, 3 * 2**30), "out of memory"),
        ((die,), "ended before it was done"),
        ((refuse,), "expected this, got that"),
    ],
)
def test_what_a_child_may_not_or_cannot_is_one_line(call, message):
    async def run():
        await Child(*call, memory=2**31).run()

    with pytest.raises(InputError, match=message) as caught:
        asyncio.run(run())
    assert "\n" not in str(caught.value)


def test_a_child_is_stopped_at_once():
    async def run():
        child = Child(sleep, memory=2**30)
        with pytest.raises(Stopped):
            await child.run(lambda phase, share: child.stop())

    start = time.monotonic()
    asyncio.run(run())
    assert time.monotonic() - start < 40


class Pretended:
    """A child that waits until it is told, and knows which ran beside it."""

    running: list["Pretended"] = []

    def __init__(self, error=None):
        self.error = error
        self.stopped = asyncio.Event()

    async def run(self, report):
        Pretended.running.append(self)
        assert len(Pretended.running) == 1
        report("normals", 0.5)
        for _ in range(5):
            await asyncio.sleep(0)
        Pretended.running.remove(self)
        if self.stopped.is_set():
            raise Stopped
        if self.error:
            raise InputError(self.error)
        return ["a warning"]

    def stop(self):
        self.stopped.set()


def test_jobs_run_one_at_a_time_in_order():
    async def run():
        queue = Queue()
        children = [Pretended(), Pretended("broken"), Pretended(), Pretended()]
        jobs = [Job(str(i), Path(), child) for i, child in enumerate(children)]
        for job in jobs:
            queue.add(job)
        await asyncio.sleep(0)
        assert [job.state for job in jobs] == ["running"] + ["waiting"] * 3
        assert queue.ahead_of(jobs[2]) == 2
        jobs[2].cancel()
        while not jobs[-1].over:
            await asyncio.sleep(0)
        return jobs

    jobs = asyncio.run(run())
    assert [job.state for job in jobs] == ["done", "failed", "cancelled", "done"]
    assert jobs[1].error == "broken" and jobs[0].warnings == ["a warning"]


def test_time_left_follows_from_the_share(monkeypatch):
    job = Job("a", Path(), None)
    monkeypatch.setattr(time, "monotonic", lambda: 100.0)
    job.progress("normals", 0.0)
    assert job.seconds_left is None
    monkeypatch.setattr(time, "monotonic", lambda: 110.0)
    job.progress("normals", 0.25)
    assert job.seconds_left == pytest.approx(30)


@pytest.mark.parametrize(
    ("name", "size", "message"),
    [
        ("run.exe", 10, "expected an image, got another kind"),
        ("a.png", 1001, "expected at most 0 MB"),
        ("../../evil.py", 10, "expected an image"),
        (".png", 10, "expected an image"),
    ],
)
def test_uploads_are_bounded(visitors, name, size, message):
    with pytest.raises(InputError, match=message):
        visitors.open().place_for(name, size)


def test_uploads_stay_in_their_folder_and_are_counted(visitors):
    visitor = visitors.open()
    for name in ("../../a b/../x.png", "..\\..\\y.png", "z é.png"):
        place = visitor.place_for(name, 800)
        assert place.parent == visitor.photographs
        place.write_bytes(b"0" * 800)
    with pytest.raises(InputError, match="at most 3 files"):
        visitor.place_for("w.png", 1)
    visitor.place_for("x.png", 800)  # again: takes the place of the first
    place.unlink()
    with pytest.raises(InputError, match="in all photographs"):
        visitor.place_for("w.png", 1000)
    visitor.begin()
    assert list(visitor.photographs.iterdir()) == []
    with pytest.raises(InputError, match="at most 2 objects"):
        visitor.begin()


def test_visitors_are_apart_and_leave_nothing(visitors):
    one, two = visitors.open(), visitors.open()
    with pytest.raises(InputError, match="2 pages are open"):
        visitors.open()
    assert one.key != two.key and len(one.key) > 20
    assert one.photographs.stat().st_mode & 0o77 == 0 or (
        one.photographs.parents[1].stat().st_mode & 0o77 == 0
    )
    target = one.target("thing")
    target.mkdir(parents=True)
    (target / "normals.png").write_bytes(b"0")
    job = Job("thing", target, Pretended())
    one.jobs[1] = job
    assert one.result(1, "normals.png") is None  # not before all is done
    job.state = "done"
    assert one.result(1, "normals.png") is not None
    assert one.result(1, "../../about") is None and one.result(2, "a") is None
    visitors.close(one)
    assert visitors.get(one.key) is None and not target.exists()
    assert two.photographs.exists()


@pytest.mark.parametrize(
    ("method", "headers", "status"),
    [
        ("POST", [(b"content-length", b"2000")], 413),
        ("POST", [], 411),
        ("POST", [(b"content-length", b"10")], 200),
        ("GET", [], 200),
    ],
)
def test_large_requests_are_refused_unread(method, headers, status):
    sent = []

    async def inner(scope, receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": []})

    async def send(message):
        sent.append(message)

    scope = {"type": "http", "method": method, "headers": headers}
    asyncio.run(BodyLimit(inner, 1000)(scope, None, send))
    assert sent[0]["status"] == status


@pytest.fixture
def folders(tmp_path):
    """Four photographs of the sample, small, with a black background."""
    photographs, about = tmp_path / "photographs", tmp_path / "about"
    photographs.mkdir()
    about.mkdir()
    for index in (0, 2, 4, 6):
        image = cv2.resize(read_image(SAMPLE / f"L_0{index}.png"), (64, 48))
        write_image(photographs / f"{index}.png", image)
    return photographs, about


def test_what_photographs_hold_is_told(folders):
    found = work.inspect(*folders, 10**6, report=silent)
    assert found["names"] == ["0.png", "2.png", "4.png", "6.png"]
    assert (found["width"], found["height"]) == (64, 48)
    assert found["transfer"] == "linear" and "16-bit" in found["transfer_rule"]
    assert found["focal"] is None and found["mask"] == "suggested"
    truth = cv2.resize(read_image(SAMPLE / "mask.png")[..., 0], (64, 48)) > 127
    mask = read_image(folders[1] / "mask.png")[..., 0] > 127
    assert (mask & truth).sum() / (mask | truth).sum() > 0.9
    assert len(list(folders[1].glob("thumbnail-*.jpg"))) == 4
    with pytest.raises(InputError, match="pixels"):
        work.inspect(*folders, 1000, report=silent)


def test_a_box_is_cut_out(folders):
    photographs, about = folders
    work.inspect(photographs, about, 10**6, report=silent)
    work.cut(about / "picture.jpg", (4, 1, 60, 47), about / "cut.png", report=silent)
    truth = cv2.resize(read_image(SAMPLE / "mask.png")[..., 0], (64, 48)) > 127
    mask = read_image(about / "cut.png")[..., 0] > 127
    assert (mask & truth).sum() / (mask | truth).sum() > 0.85


def test_an_empty_mask_is_refused_before_anything_is_loaded(folders):
    photographs, about = folders
    write_image(about / "drawn.png", np.zeros((24, 32), np.uint8))
    with pytest.raises(InputError, match="the mask is empty"):
        work.estimate(
            *(photographs, about / "out", about / "drawn.png", work.Choices(), 10**6),
            report=silent,
        )


def test_a_bad_port_is_one_line(capsys):
    assert app(["--port", "70000"]) == 2
    assert "--port: expected 1 to 65535, got 70000" in capsys.readouterr().err
