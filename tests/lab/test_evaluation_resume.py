"""Evaluations killed, restarted or shared give the bytes of one left alone."""

import random
import re
import signal
import subprocess
import sys
import time

import evaluation_data as data
import pytest

from unips_jax.cli import evaluate

PUBLISHED = ("report.html", "sheets/*.png", "tables/*", "results/*/*/*")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return data.make_ps_wild(tmp_path_factory.mktemp("data"), objects=3, size=20)


def start(root, work):
    arguments = data.ps_wild_arguments(root, work, 16, "3", "4")
    return subprocess.Popen(
        [sys.executable, "-m", "unips_jax.cli.evaluate", *arguments],
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
        path.relative_to(work).as_posix(): timeless(path.read_bytes())
        for pattern in PUBLISHED
        for path in work.glob(pattern)
        if not path.name.startswith(".")
    }


def timeless(page):
    """Without what a report says of its own making: when, and by what command."""
    return re.sub(rb' id="(date|command)">.*?<', rb"<", page)


def results(work):
    """Identity of every finished result: it changes if the file is written again."""
    return {
        path: (path.stat().st_ino, path.stat().st_mtime_ns)
        for path in work.glob("results/*/*/*.json")
    }


@pytest.fixture(scope="module")
def uninterrupted(root, tmp_path_factory):
    work = tmp_path_factory.mktemp("uninterrupted")
    assert evaluate.main(data.ps_wild_arguments(root, work, 16, "3", "4")) == 0
    found = published(work)
    assert len(results(work)) == 36 and "report.html" in found
    return found


def kill_after(process, work, *, files, pause):
    """SIGKILL once that number of finished files is there, and a moment later."""
    while process.poll() is None:
        if sum(len(list(work.glob(pattern))) for pattern in PUBLISHED) >= files:
            break
        time.sleep(0.005)
    time.sleep(pause)
    process.send_signal(signal.SIGKILL)
    process.communicate()


def check_kill(root, work, rng, *, files):
    """Kills an evaluation; what was finished before stays untouched."""
    before = results(work)
    process = start(root, work)
    kill_after(process, work, files=files, pause=rng.uniform(0, 0.02))
    after = results(work)
    assert {path: after.get(path) for path in before} == before


def check_finish(root, work, uninterrupted, *, processes):
    """Finishes what is left, computing nothing again, with the same bytes."""
    before = results(work)
    for process in [start(root, work) for _ in range(processes)]:
        finish(process)
    after = results(work)
    assert {path: after[path] for path in before} == before
    assert published(work) == uninterrupted


def test_killed_once_and_finished_by_two_processes(root, tmp_path, uninterrupted):
    check_kill(root, tmp_path, random.Random(0), files=20)
    check_finish(root, tmp_path, uninterrupted, processes=2)


@pytest.mark.slow
def test_killed_at_ten_random_moments(root, tmp_path, uninterrupted):
    rng = random.Random(1)
    # Results and their maps are 54 files, tables, sheets and the report 20 more.
    for files in sorted(rng.randint(0, 72) for _ in range(10)):
        check_kill(root, tmp_path, rng, files=files)
    check_finish(root, tmp_path, uninterrupted, processes=1)


@pytest.mark.slow
def test_two_processes_from_the_start(root, tmp_path, uninterrupted):
    check_finish(root, tmp_path, uninterrupted, processes=2)
