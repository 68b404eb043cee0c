"""What the commands share."""

import subprocess
import sys

CHATTY = """
from unips_jax.command import command
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
