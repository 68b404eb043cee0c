"""The application: photographs in, normals, surface and viewer out, in a browser.

It runs on this machine and is reached from it alone. Photographs are kept in a
temporary folder until their page is closed. Needs `pip install 'unips-jax[app]'`.
"""

import dataclasses
import sys
from collections.abc import Sequence

from unips_jax.console import command, parse
from unips_jax.errors import InputError


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `unips app`.

    Attributes:
        host: address to listen on. Whoever reaches it may use this machine: there is
            no password.
        port: to listen on.
        no_show: do not open a browser.
    """

    host: str = "127.0.0.1"
    port: int = 8080
    no_show: bool = False


@command
def main(argv: Sequence[str] | None = None) -> None:
    """`unips app`."""
    options = parse(Options, argv, prog="unips app", description=__doc__)
    if not 0 < options.port < 65536:
        raise InputError(f"--port: expected 1 to 65535, got {options.port}")
    try:
        from unips_jax.app.server import serve
    except ModuleNotFoundError as error:
        raise InputError(
            f"unips app needs {error.name}: pip install 'unips-jax[app]'"
        ) from None
    print(f"http://{options.host}:{options.port} (Ctrl-C ends it)", flush=True)
    serve(options.host, options.port, show=not options.no_show)


if __name__ == "__main__":
    sys.exit(main())
