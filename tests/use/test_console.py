"""What the commands share."""

import errno
import importlib
import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import jax
import pytest
import rich.progress

from unips_jax.cli import check, estimate, evaluate
from unips_jax.cli.main import COMMANDS
from unips_jax.cli.main import main as unips
from unips_jax.console import cache_compilations, command, parse, track
from unips_jax.errors import InputError

CHATTY = """
from unips_jax.console import command
raise SystemExit(command(lambda _: print("line\\n" * 100_000))())
"""


def test_reader_that_leaves_early_is_no_error():
    with subprocess.Popen(
        [sys.executable, "-c", CHATTY], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout.readline() == b"line\n"
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait() == 141


def test_slow_items_have_a_time_left(monkeypatch):
    clock, bars = [0.0], []

    class Bar(rich.progress.Progress):
        def __init__(self, **options):
            super().__init__(get_time=lambda: clock[0], **options)
            bars.append(self)

    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setattr(rich.progress, "Progress", Bar)
    monkeypatch.setattr(sys, "stderr", Terminal())
    for item in track(range(5), "waiting"):
        if item == 4:
            assert bars[0].tasks[0].time_remaining == 600
        clock[0] += 600


@pytest.mark.parametrize("name", [*COMMANDS, "render --engine cycles"])
def test_help_names_the_command(name, capsys):
    with pytest.raises(SystemExit) as end:
        unips([*name.split(), "--help"])
    assert end.value.code == 0
    assert f"usage: unips {name} [-h]" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["estimat"], "no command 'estimat'; perhaps estimate"),
        (["validate", "--scene", "3"], "no option --scene: perhaps --scenes"),
        (["demo", "--outptu=x"], "no option --outptu=x: perhaps --output"),
        (["render", "-o", "x", "more"], "does not expect more: see `unips render"),
        (["estimate", "-o", "out"], "expected a folder of photographs, got none"),
    ],
)
def test_a_slip_has_its_nearest_named(arguments, expected, capsys):
    assert unips(arguments) == 2
    assert expected in capsys.readouterr().err


REQUIRED = "--benchmark uw --root a --workdir b"


@pytest.mark.parametrize(
    ("module", "typed", "said"),
    [
        (check, "a --exclude x* --json --exclude=y*", "--exclude: expected once, with"),
        (estimate, "a -o b --known-lights c --known-lights d", "got it twice; write"),
        (evaluate, f"{REQUIRED} -m sh1 --method l1 -ml1", "--method: .* it 3 times"),
        (evaluate, f"{REQUIRED} --seeds 1 --seed 2", "--seeds: .* --seeds A B$"),
        (evaluate, f"{REQUIRED} --num_images 3 --num-images 4", "--num-images: .*once"),
    ],
)
def test_an_option_of_several_values_is_given_once(module, typed, said):
    with pytest.raises(InputError, match=said):
        parse(module.Options, typed.split(), prog="unips", description="")


def test_values_are_no_options_and_of_one_value_the_last_holds():
    typed = "--exclude=--exclude x --mask none --mask auto -- --exclude --exclude"
    found = parse(check.Options, typed.split(), prog="unips", description="")
    assert found.exclude == ("--exclude", "x") and found.mask == "auto"
    assert len(found.folders) == 2


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "a/b"), "a/b: No space left"),
        (OSError(errno.ENOSPC, "No space left on device"), "error: No space left"),
        (MemoryError(), "out of memory"),
        (RuntimeError("RESOURCE_EXHAUSTED: Out of\nmemory"), "images (RESOURCE_EXH"),
    ],
)
def test_what_is_no_bug_is_one_line(error, expected, capsys):
    def fail(argv):
        raise error

    assert command(fail)([]) == 2
    shown = capsys.readouterr().err
    assert expected in shown and shown.count("\n") == 1


@pytest.mark.parametrize("error", [RuntimeError("x"), ValueError("x"), OSError("x")])
def test_a_bug_is_not_hidden(error):
    def fail(argv):
        raise error

    with pytest.raises(type(error)):
        command(fail)([])


@pytest.mark.parametrize("name", ["demo", "estimate in", "render", "validate"])
def test_a_platform_that_is_not_there_is_one_line(name, tmp_path):
    program = [sys.executable, "-m", "unips_jax", *name.split()]
    output = [] if name == "validate" else ["-o", str(tmp_path / "out")]
    environment = {**os.environ, "JAX_PLATFORMS": "tpu"}
    ran = subprocess.run(
        [*program, *output], env=environment, capture_output=True, text=True
    )
    assert ran.returncode == 2 and ran.stderr.count("\n") == 1
    assert "error: JAX_PLATFORMS=tpu: expected a platform" in ran.stderr


def test_a_folder_that_a_program_set_for_compilations_stays(monkeypatch, tmp_path):
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    before = jax.config.jax_compilation_cache_dir
    try:
        jax.config.update("jax_compilation_cache_dir", str(tmp_path / "mine"))
        cache_compilations()
        assert jax.config.jax_compilation_cache_dir == str(tmp_path / "mine")
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_without_a_home_nothing_is_kept_but_in_a_folder_given(monkeypatch, tmp_path):
    """As for a user without HOME and without an entry in the list of users."""

    def home():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", home)
    for name in ("JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    before = jax.config.jax_compilation_cache_dir
    cache_compilations()
    assert jax.config.jax_compilation_cache_dir == before
    try:
        cache_compilations(tmp_path)
        assert jax.config.jax_compilation_cache_dir == str(tmp_path)
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


INTERRUPTED = """
import importlib, os, signal
from unips_jax.cli.main import main
def interrupted(name):
    os.kill(os.getpid(), signal.SIGINT)
importlib.import_module = interrupted
main(["demo"])
"""


def test_an_interrupt_while_modules_are_imported_has_no_traceback():
    ran = subprocess.run([sys.executable, "-c", INTERRUPTED], capture_output=True)
    assert ran.returncode == -signal.SIGINT
    assert ran.stderr == b""


def test_an_interrupt_of_a_command_is_one_word(monkeypatch, capsys):
    def interrupted(argv):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(60)

    module = SimpleNamespace(main=command(interrupted))
    monkeypatch.setattr(importlib, "import_module", lambda name: module)
    # What a shell starts in the background ignores it.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert unips(["demo"]) == 130
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().err == "interrupted\n"


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_unips_into_a_closed_pipe_is_silent(option):
    """As in `unips --help | head -0`: what nobody reads is no error to talk of."""
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "unips_jax", option]
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.parametrize("closed", ["stdout", "stderr"])
def test_a_closed_stream_is_no_error(closed, monkeypatch, capsys):
    monkeypatch.setattr(sys, closed, None)
    assert command(lambda _: print("line"))() == 0
    opened = getattr(sys, closed)

    def refuses(_):
        raise InputError("no")

    assert command(refuses)() == 2
    opened.close()


def test_halves_of_compilations_are_removed(tmp_path, monkeypatch):
    """JAX writes two files for each; without the second it keeps nothing any more."""
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    ours, other = tmp_path / "unips_jax", tmp_path / "other"
    for folder in (ours, other):
        folder.mkdir()
        for name in ("whole-cache", "whole-atime", "half-cache", "other"):
            (folder / name).write_bytes(b"x")
    before = jax.config.jax_compilation_cache_dir
    try:
        jax.config.update("jax_compilation_cache_dir", None)
        cache_compilations()
        cache_compilations(other)  # where other programs may keep theirs
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
    left = {path.name for path in ours.iterdir()} - {".lockfile"}
    assert left == {"whole-cache", "whole-atime", "other"}
    assert len(list(other.iterdir())) == 4
