"""A process that does one call after the other: warm, of bounded memory, ended at will.

What it imported and compiled serves the next call.
"""

import asyncio
import contextlib
import multiprocessing
import signal
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any

from unips_jax.app.limits import limit_memory
from unips_jax.errors import InputError

Report = Callable[[str, float], None]
"""Called with a phase's name and the share of it that is done."""


def _ignore(phase: str, share: float) -> None:
    pass


class Worker:
    """One process at most; it starts with the first call."""

    def __init__(self, memory: int) -> None:
        """Memory is in bytes; 0 for no limit."""
        self._memory = memory
        self._lock = asyncio.Lock()
        self._thread = ThreadPoolExecutor(1)  # waits for the process
        self._process: Any = None
        self._pipe: Connection | None = None

    async def call(
        self,
        function: Callable[..., Any],
        *arguments: Any,
        report: Report = _ignore,
        seconds: float | None = None,
    ) -> Any:
        """Calls a module's function there, in turn; its keyword `report` is a `Report`.

        A call that is cancelled, or takes longer than `seconds`, ends the process.
        """
        async with self._lock:
            try:
                async with asyncio.timeout(seconds):
                    return await self._call(function, arguments, report)
            except TimeoutError:
                self.stop()
                raise InputError(
                    f"expected to be done within {seconds:.0f} s, got no end; give "
                    "fewer or smaller photographs"
                ) from None
            except asyncio.CancelledError:
                self.stop()
                raise

    async def _call(
        self, function: Callable[..., Any], arguments: tuple[Any, ...], report: Report
    ) -> Any:
        loop = asyncio.get_running_loop()
        try:
            if self._process is None or not self._process.is_alive():
                await loop.run_in_executor(self._thread, self._start)
            pipe = self._pipe
            assert pipe is not None
            pipe.send((function, arguments))
            while True:
                kind, *values = await loop.run_in_executor(self._thread, pipe.recv)
                if kind == "progress":
                    report(*values)
                elif kind in ("failed", "broken"):
                    if kind == "broken":
                        self.stop()  # what is left of its memory goes with it
                    raise InputError(values[0])
                else:
                    return values[0]
        except (EOFError, OSError):
            self.stop()
            raise InputError(
                "the process that did the work ended before it was done, most likely "
                "for want of memory; give fewer or smaller photographs"
            ) from None

    def _start(self) -> None:
        self.stop()
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(theirs, self._memory), daemon=True
        )
        self._process.start()
        theirs.close()  # now the pipe ends when the process does

    def stop(self) -> None:
        """Ends the process at once, if there is one."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.join(10)

    def close(self) -> None:
        """Ends the process, and waits for no other."""
        self.stop()
        self._thread.shutdown(wait=False, cancel_futures=True)


def _serve(pipe: Connection, memory: int) -> None:
    from unips_jax.console import reason_of

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the server ends us
    limit_memory(memory)

    def report(phase: str, share: float) -> None:
        pipe.send(("progress", phase, share))

    with contextlib.suppress(EOFError, OSError):  # the server is gone
        while True:
            function, arguments = pipe.recv()
            try:
                answer = ("done", function(*arguments, report=report))
            except InputError as error:
                answer = ("failed", " ".join(str(error).split()))
            except Exception as error:
                text = reason_of(error) or f"{type(error).__name__}: {error}"
                pipe.send(("broken", " ".join(text.split())))
                return
            pipe.send(answer)
