"""The `unips` command: finds the subcommand's module and hands over."""

import importlib
import sys
from collections.abc import Sequence

# Each command's module and what it does.
COMMANDS = {
    "estimate": ("cli.estimate", "normals from folders of photographs"),
    "train": ("train", "train the network"),
    "validate": ("cli.validate", "score weights on held-out scenes"),
    "eval": ("cli.eval", "evaluate UniPS and other methods on benchmarks"),
    "render": ("cli.render", "make scenes with known normals"),
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
        module = importlib.import_module(f"unips_jax.{COMMANDS[name][0]}")
        return module.main(arguments[1:])
    lines = [f"  {command:10}{text}" for command, (_, text) in COMMANDS.items()]
    usage = "\n".join(["usage: unips COMMAND [--help] ...", "", *lines])
    if name in ("-h", "--help"):
        print(usage)
        return 0
    if name == "--version":
        from unips_jax import __version__

        print(__version__)
        return 0
    print(f"error: no command {name!r}\n{usage}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
