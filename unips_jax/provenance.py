"""Which code made a result: so that results of changed code are kept apart."""

import ast
import functools
import hashlib
from collections.abc import Iterator
from pathlib import Path

_PACKAGE = Path(__file__).parent
_NAME = __package__
# What users read while results are computed does not change them.
_SILENT = {f"{_NAME}.errors", f"{_NAME}.console"}


@functools.cache
def code_hash(*modules: str) -> str:
    """A hash of modules, such as "evaluation.scores", and of all they import of ours.

    What is hashed is the syntax without docstrings: comments and layout do not count.
    Imports are followed wherever they stand, also those inside functions; data files
    are not, nor what only type checkers import.
    """
    digest = hashlib.blake2b(digest_size=8)
    reached = _reached(f"{_NAME}.{module}" for module in modules)
    for name in sorted(reached):
        tree = _without_docstrings(reached[name])
        digest.update(f"{name}\n{ast.dump(tree)}\n".encode())
    return digest.hexdigest()


def _reached(names: Iterator[str]) -> dict[str, ast.Module]:
    """The modules, and what they import of the package, directly or not, parsed."""
    reached: dict[str, ast.Module] = {}
    left = list(names)
    while left:
        name = left.pop()
        if name not in reached and name not in _SILENT:
            reached[name] = ast.parse(_file(name).read_bytes())
            left.extend(_imports(reached[name]))
    return reached


def _imports(tree: ast.Module) -> Iterator[str]:
    """Modules of the package that a module imports (absolutely, as ours all do)."""
    for node in _running(tree):
        if isinstance(node, ast.Import):
            yield from (x.name for x in node.names if _is_ours(x.name))
        elif isinstance(node, ast.ImportFrom) and _is_ours(node.module or ""):
            for alias in node.names:
                # A name is a module of the package, or something in the package.
                inner = f"{node.module}.{alias.name}"
                yield inner if _file(inner).is_file() else str(node.module)


def _running(node: ast.AST) -> Iterator[ast.AST]:
    """A syntax tree's nodes, but for those that only type checkers see."""
    yield node
    for child in ast.iter_child_nodes(node):
        unseen = isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test)
        if not unseen:
            yield from _running(child)


def _is_ours(name: str) -> bool:
    return name == _NAME or name.startswith(f"{_NAME}.")


def _file(name: str) -> Path:
    """A module's file; of a package, its `__init__.py`."""
    path = _PACKAGE.joinpath(*name.split(".")[1:])
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def _without_docstrings(tree: ast.Module) -> ast.Module:
    for node in ast.walk(tree):
        documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
        if isinstance(node, documented) and ast.get_docstring(node, clean=False):
            node.body = node.body[1:]
    return tree
