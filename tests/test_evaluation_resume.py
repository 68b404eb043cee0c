"""Evaluations killed, restarted or shared give the bytes of one left alone."""

import random
import signal
import subprocess
import sys
import time

import evaluation_data as data
import pytest

PUBLISHED = ("report.html", "sheets/*.png", "tables/*", "results/*/*/*")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return data.make_ps_wild(tmp_path_factory.mktemp("data"), objects=3, size=20)


def start(root, work):
    arguments = [
        *("--benchmark", "ps-wild", "--root", str(root), "--workdir", str(work)),
        *("--method", "woodham", "constant", "--num-images", "3", "4"),
        *("--crop-size", "16"),
    ]
    return subprocess.Popen(
        [sys.executable, "-m", "unips_jax.eval", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(process):
    _, errors = process.communicate()
    assert process.returncode == 0, errors


def published(work):
    """Contents of everything that is meant to be looked at."""
    return {
        path.relative_to(work).as_posix(): path.read_bytes()
        for pattern in PUBLISHED
        for path in work.glob(pattern)
        if not path.name.startswith(".")
    }


def results(work):
    """Identity of every finished result: it changes if the file is written again."""
    return {
        path: (path.stat().st_ino, path.stat().st_mtime_ns)
        for path in work.glob("results/*/*/*.json")
    }


@pytest.fixture(scope="module")
def uninterrupted(root, tmp_path_factory):
    work = tmp_path_factory.mktemp("uninterrupted")
    finish(start(root, work))
    found = published(work)
    assert len(results(work)) == 36 and "report.html" in found
    return found


def kill_after(process, work, *, files, pause):
    """SIGKILL once so many finished files are there, and a moment later."""
    while process.poll() is None:
        if sum(len(list(work.glob(pattern))) for pattern in PUBLISHED) >= files:
            break
        time.sleep(0.001)
    time.sleep(pause)
    process.send_signal(signal.SIGKILL)
    process.communicate()


def check_kills(root, work, uninterrupted, *, moments, seed):
    rng = random.Random(seed)
    work.mkdir()
    # Results and their maps are 54 files, tables, sheets and the report 20 more.
    for files in sorted(rng.randint(0, 72) for _ in range(moments)):
        before = results(work)
        process = start(root, work)
        kill_after(process, work, files=files, pause=rng.uniform(0, 0.02))
        after = results(work)
        assert {path: after.get(path) for path in before} == before
    before = results(work)
    finish(start(root, work))
    after = results(work)
    assert {path: after[path] for path in before} == before
    assert published(work) == uninterrupted


def test_killed_twice_and_restarted(root, tmp_path, uninterrupted):
    check_kills(root, tmp_path / "work", uninterrupted, moments=2, seed=0)


@pytest.mark.slow
def test_killed_at_ten_random_moments(root, tmp_path, uninterrupted):
    check_kills(root, tmp_path / "work", uninterrupted, moments=10, seed=1)


def test_two_processes_share_a_work_folder(root, tmp_path, uninterrupted):
    pair = [start(root, tmp_path) for _ in range(2)]
    for process in pair:
        finish(process)
    assert published(tmp_path) == uninterrupted
