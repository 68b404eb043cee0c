"""Work in a process of its own: its memory is bounded, and it can be stopped."""

import asyncio
import multiprocessing
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from unips_jax.app.limits import limit_memory
from unips_jax.errors import InputError

Report = Callable[[str, float], None]
"""Called with a phase's name and the share of it that is done."""


class Stopped(Exception):
    """The work was stopped."""


class Child:
    """One call of a function, in a spawned process."""

    def __init__(
        self, function: Callable[..., Any], *arguments: Any, memory: int
    ) -> None:
        """Prepares a call.

        Args:
            function: of a module; its keyword `report` is a `Report`.
            arguments: its arguments; pickled.
            memory: limit in bytes.
        """
        context = multiprocessing.get_context("spawn")
        self._receiver, sender = context.Pipe(duplex=False)
        self._process = context.Process(
            target=_work, args=(sender, memory, function, arguments), daemon=True
        )
        self._sender: Connection | None = sender
        self._stopped = False

    async def run(self, report: Report = lambda phase, share: None) -> Any:
        """Runs it to its end, and gives its result.

        Args:
            report: is told how far it is.

        Raises:
            InputError: if it did, or the process died.
            Stopped: if it was stopped.
        """
        if self._stopped:
            raise Stopped
        await asyncio.to_thread(self._process.start)
        assert self._sender is not None
        self._sender.close()  # the process' own end tells when it died
        try:
            return await self._listen(report)
        finally:
            self.stop()
            await asyncio.to_thread(self._process.join)

    async def _listen(self, report: Report) -> Any:
        while True:
            try:
                kind, *values = await asyncio.to_thread(self._receiver.recv)
            except (EOFError, OSError):
                if self._stopped:
                    raise Stopped from None
                raise InputError(
                    "the process that did the work ended before it was done, most "
                    "likely for want of memory; give fewer or smaller photographs"
                ) from None
            if kind == "progress":
                report(*values)
            elif kind == "failed":
                raise InputError(values[0])
            else:
                return values[0]

    def stop(self) -> None:
        """Ends the process at once, if it runs."""
        self._stopped = True
        if self._process.pid is not None and self._process.is_alive():
            self._process.kill()


def _work(
    sender: Connection, memory: int, function: Callable[..., Any], arguments: Any
) -> None:
    from unips_jax.console import reason_of

    limit_memory(memory)

    def report(phase: str, share: float) -> None:
        sender.send(("progress", phase, share))

    try:
        sender.send(("done", function(*arguments, report=report)))
    except Exception as error:
        text = reason_of(error) or f"{type(error).__name__}: {error}"
        sender.send(("failed", " ".join(text.split())))
