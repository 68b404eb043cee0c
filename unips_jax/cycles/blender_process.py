"""Blender's Python as a process of its own: requests out, pictures back.

`bpy` needs NumPy below 2 and JAX one above, so they cannot share an environment. A
crash or a hang there costs one object, not the run.
"""

import contextlib
import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import IO, Any

import numpy as np
import OpenEXR

from unips_jax.errors import InputError

VARIABLE = "UNIPS_BPY_PYTHON"
SETUP = "python tools/render_cycles.py --setup .venv-bpy"


def python_in(environment: Path) -> Path:
    """The Python of a virtual environment."""
    windows = sys.platform == "win32"
    return environment / ("Scripts/python.exe" if windows else "bin/python")


class BlenderError(RuntimeError):
    """A request failed; the process is ready for the next object."""


def find_python() -> str:
    """The Python that has `bpy`: `$UNIPS_BPY_PYTHON`, or this one."""
    python = os.environ.get(VARIABLE, sys.executable)
    try:
        probe = subprocess.run(
            [python, "-c", "import bpy"], capture_output=True, text=True, timeout=300
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise InputError(f"{VARIABLE}={python}: cannot be run ({error})") from None
    if probe.returncode:
        reason = (probe.stderr.strip().splitlines() or ["no message"])[-1]
        raise InputError(
            f"{python} cannot import bpy ({reason}); set up Blender's Python with "
            f"`{SETUP}` and set {VARIABLE}={python_in(Path('.venv-bpy'))}"
        )
    return python


class Blender:
    """A running `blender/worker.py`."""

    def __init__(self, python: str, *, threads: int = 0) -> None:
        """For a Python that has `bpy`; 0 threads of the renderer are all cores."""
        self._python, self._threads = python, threads
        self._folder = tempfile.TemporaryDirectory(prefix="unips-cycles-")
        self._process: subprocess.Popen[str] | None = None
        self._answers: queue.SimpleQueue[str] = queue.SimpleQueue()

    @property
    def folder(self) -> Path:
        """Where pictures come and go."""
        return Path(self._folder.name)

    def __enter__(self) -> "Blender":
        """Starts nothing yet: the first request does."""
        return self

    def __exit__(self, *_: object) -> None:
        """Ends the process and removes its files."""
        self._stop()
        self._folder.cleanup()

    def _start(self) -> subprocess.Popen[str]:
        if self._process is None:
            here = str(Path(__file__).parent)
            environment = {**os.environ, "PYTHONPATH": here}
            command = [self._python, "-m", "blender.worker", str(self._threads)]
            with (self.folder / "log.txt").open("w") as log:
                self._process = subprocess.Popen(
                    command,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    env=environment,
                    text=True,
                )
            # Pipes cannot be waited for with a limit under Windows, queues can.
            self._answers = queue.SimpleQueue()
            streams = (self._process.stdout, self._answers)
            self._reader = threading.Thread(target=_pass_on, args=streams, daemon=True)
            self._reader.start()
        return self._process

    def _stop(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            assert process.stdin
            process.kill()
            process.wait()
            self._reader.join()
            with contextlib.suppress(OSError):  # of what could not be sent
                process.stdin.close()

    def ask(self, do: str, *, limit_s: float = 3600.0, **arguments: Any) -> Any:
        """Asks for a method of `blender.worker.Studio`; waits for the answer.

        `BlenderError` if the request failed, or the process died or hung for `limit_s`
        seconds; the next request starts another, which knows of no object.
        """
        process = self._start()
        assert process.stdin
        line, what = "", "died"
        try:
            print(json.dumps({"do": do, **arguments}), file=process.stdin, flush=True)
            line = self._answers.get(timeout=limit_s)
        except queue.Empty:
            what = f"did not answer in {limit_s:.0f} s"
        except OSError:  # it is gone
            pass
        if not line:
            self._stop()
            log = (self.folder / "log.txt").read_text(errors="replace")
            last = [text for text in log.splitlines() if text.strip()][-1:]
            raise BlenderError(f"Blender {what} at {do!r}: {' '.join(last)}")
        answer = json.loads(line)
        if "error" in answer:
            raise BlenderError(answer["error"])
        return answer["ok"]

    def picture(self, do: str, **arguments: Any) -> dict[str, np.ndarray]:
        """Asks for a picture: its channels by name, float32 `[H, W]`."""
        path = self.folder / "picture.exr"
        path.unlink(missing_ok=True)
        self.ask(do, path=str(path), **arguments)
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
        return {
            name.removeprefix("ViewLayer."): np.asarray(channel.pixels, np.float32)
            for name, channel in channels.items()
        }


def _pass_on(lines: IO[str], answers: "queue.SimpleQueue[str]") -> None:
    """Passes on what a process prints, and an empty line once it has ended."""
    with lines:
        for line in lines:
            answers.put(line)
    answers.put("")
