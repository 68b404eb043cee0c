"""The `unips` command: finds the subcommand's module and hands over.

Each command has its own module and loads no other's.
"""

import contextlib
import importlib
import signal
import sys
from collections.abc import Iterator, Sequence

# Each command's module and what it does.
COMMANDS = {
    "estimate": ("cli.estimate", "normals from folders of photographs"),
    "check": ("cli.check", "what is wrong with photographs, before an estimate"),
    "train": ("train", "train the network"),
    "surface": ("cli.surface", "depth and a mesh from normals"),
    "relight": ("cli.relight", "images of normals and materials under new light"),
    "app": ("cli.app", "all of it in a browser, on this machine"),
    "view": ("cli.view", "a result as an HTML file to look at"),
    "multiview": ("cli.multiview", "results of several views, for whole objects"),
    "validate": ("cli.validate", "score weights on held-out scenes"),
    "eval": ("cli.evaluate", "evaluate UniPS and other methods on benchmarks"),
    "render": ("cli.render", "make scenes with known normals"),
    "export": ("cli.export", "the network as ONNX or StableHLO, for other programs"),
    "demo": ("cli.demo", "a bundled object's normals, compared with the truth"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs `unips COMMAND ...`.

    Args:
        argv: arguments after `unips` (None: those of the process).

    Returns:
        The exit status; 2 for an unknown command.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    name = arguments[0] if arguments else "--help"
    if name in COMMANDS:
        with _interrupts_end_at_once():
            module = importlib.import_module(f"unips_jax.{COMMANDS[name][0]}")
        return module.main(arguments[1:])
    if name in ("-h", "--help", "--version"):
        from unips_jax.console import command
        from unips_jax.version import __version__

        text = __version__ if name == "--version" else _usage()
        return command(lambda _: print(text))(arguments)
    import difflib

    near = difflib.get_close_matches(name, COMMANDS, n=1)
    hint = f"; perhaps {near[0]}" if near else ""
    print(f"error: unips has no command {name!r}{hint}\n{_usage()}", file=sys.stderr)
    return 2


def _usage() -> str:
    lines = [f"  {command:10}{text}" for command, (_, text) in COMMANDS.items()]
    return "\n".join(
        [
            "usage: unips COMMAND [--help] ...",
            "       unips --version",
            "",
            "Surface normals from photographs under unknown light.",
            "",
            *lines,
        ]
    )


@contextlib.contextmanager
def _interrupts_end_at_once() -> Iterator[None]:
    """While modules are imported Ctrl-C ends the process, without a traceback."""
    try:
        before = signal.signal(signal.SIGINT, signal.SIG_DFL)
    except ValueError:  # not the main thread
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


if __name__ == "__main__":
    sys.exit(main())
