"""The application: photographs in, normals, surface and viewer out, in a browser.

It runs on this machine and is reached from it alone. Results are folders that stay;
photographs stay with them, until removed on the page. Needs the extra `app`.
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

from unips_jax.console import command, parse
from unips_jax.errors import InputError, install_hint


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `unips app`.

    Attributes:
        results: folder for the results; ~/unips if not given.
        host: address to listen on. Whoever reaches it may use this machine: there is
            no password.
        port: to listen on; 8080, or the next that is free, if not given.
        weights: shipped weights or a .safetensors file.
        no_show: do not open a browser.
    """

    results: Path | None = None
    host: str = "127.0.0.1"
    port: int | None = None
    weights: str = "tiny"
    no_show: bool = False


@command
def main(argv: Sequence[str] | None = None) -> None:
    """`unips app`."""
    options = parse(Options, argv, prog="unips app", description=__doc__)
    if options.port is not None and not 0 < options.port < 65536:
        raise InputError(f"--port: expected 1 to 65535, got {options.port}")
    try:
        from unips_jax.app.server import serve
    except ModuleNotFoundError as error:
        raise InputError(
            f"unips app needs {error.name}: {install_hint('app')}"
        ) from None
    from unips_jax.weights import weights_path

    weights_path(options.weights)  # one that is missing is named now
    serve(
        options.host,
        options.port,
        results=(options.results or _home() / "unips").resolve(),
        show=not options.no_show,
        weights=options.weights,
    )


def _home() -> Path:
    try:
        return Path.home()
    except RuntimeError:
        raise InputError(
            "--results: expected a folder, found no home folder for one; name it"
        ) from None


if __name__ == "__main__":
    sys.exit(main())
