"""Disks that are soon full."""

import contextlib
import errno
import os
import shutil
import subprocess

import pytest

from unips_jax.io import door


@contextlib.contextmanager
def small_disk(folder, size):
    """A disk of this many bytes, which only the superuser can mount."""
    folder.mkdir()
    options = ["-t", "tmpfs", "-o", f"size={size}", "none", str(folder)]
    try:
        mounted = subprocess.run(["mount", *options], capture_output=True).returncode
    except FileNotFoundError:
        mounted = -1
    if mounted != 0:
        pytest.skip("no file system can be mounted")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def fill_after(monkeypatch, count):
    """The disk is full after this many files that the package writes."""
    left = iter(range(count))
    new_path, copy = door.new_path, shutil.copy2

    def full():
        if next(left, None) is None:
            raise OSError(errno.ENOSPC, "No space left on device")

    @contextlib.contextmanager
    def new(path, **options):
        with new_path(path, **options) as part:
            full()
            yield part

    def copied(*arguments, **options):
        full()
        return copy(*arguments, **options)

    def refused(*_, **__):
        raise OSError(errno.EPERM, "no links here")

    monkeypatch.setattr(door, "new_path", new)
    monkeypatch.setattr(shutil, "copy2", copied)
    monkeypatch.setattr(os, "link", refused)


def files_below(folder):
    """The contents of all files, by their paths; folders too."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }
