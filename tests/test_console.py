"""What the commands share."""

import io
import subprocess
import sys

import rich.progress

from unips_jax.console import track

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
