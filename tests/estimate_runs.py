"""Runs `unips estimate` in this process."""

from unips_jax.cli import main as cli


def run(*arguments):
    return cli.main(["estimate", *map(str, arguments)])
