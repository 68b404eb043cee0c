"""A method with its options: what it is called, and what its results depend on."""

import ast
import hashlib
import inspect
import re
import typing
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from typeguard import TypeCheckError, check_type

from unips_jax.baselines.method import Method
from unips_jax.errors import InputError
from unips_jax.evaluation.store import is_work_folder

if TYPE_CHECKING:
    from unips_jax.evaluation.normal_files import NormalFiles

DAGGER = "\N{DAGGER}"


class Variant(NamedTuple):
    """A method with its options: a column of the tables."""

    label: str  # its name in tables, unique in a run
    key: dict[str, Any]  # what its results depend on, as JSON values
    run: Method
    about: str = ""  # what it is, one line
    oracle: bool = False  # whether the truth chooses the signs of its normals
    # where its normals lie, in place of `run`, which then only refuses
    files: "NormalFiles | None" = None
    foreign: bool = False  # not ours: are its axes turned?


def parse_options(request: str, text: str) -> dict[str, Any]:
    """The options `option=value,option=value` of a whole request, named in errors."""
    options: dict[str, Any] = {}
    # Commas inside parentheses belong to a value.
    for part in re.split(r",(?![^()]*\))", text) if text else []:
        name, equals, value = part.partition("=")
        if not name.isidentifier() or not equals:
            raise InputError(f"method {request!r}: expected option=value, got {part!r}")
        try:
            options[name] = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            options[name] = value
    return options


def built(
    request: str,
    factory: Callable[..., Any],
    options: Mapping[str, Any],
    *first: Any,
    advice: str = "",
) -> Any:
    """What a factory makes of options that its signature allows, after `first`."""
    try:
        _check_types(factory, options)
        return factory(*first, **options)
    except (TypeError, ValueError) as error:
        raise InputError(f"method {request!r}: {error}{advice}") from error


def _check_types(factory: Callable[..., Any], options: Mapping[str, Any]) -> None:
    try:
        kinds = typing.get_type_hints(factory)
    except (NameError, TypeError):  # names that only type checkers see
        return
    for name in kinds.keys() & options.keys():
        try:
            check_type(options[name], kinds[name])
        except TypeCheckError:
            wanted, got = inspect.formatannotation(kinds[name]), options[name]
            raise TypeError(f"{name}: expected {wanted}, got {got!r}") from None


def label_of(name: str, options: Mapping[str, Any], *, oracle: bool) -> str:
    """A method's name with its options, without folders."""
    words = [
        f"{key}={Path(value).stem if is_file(value) else value}"
        for key, value in options.items()
    ]
    return name + DAGGER * oracle + ":" * bool(words) + ",".join(words)


def described(about: str, *, oracle: bool) -> str:
    """What a method is, with what the dagger means."""
    return about + f". {DAGGER}: signs of x, y and z chosen by the truth" * oracle


def take_oracle(options: dict[str, Any]) -> bool:
    """Whether the truth chooses the signs; takes `sign=oracle` out of the options."""
    oracle = options.get("sign") == "oracle"
    if oracle:
        del options["sign"]
    return oracle


def is_file(value: Any) -> bool:
    """Whether an option's value names a file."""
    return isinstance(value, str) and Path(value).is_file()


def hashed(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options as they stand in result keys: a file stands for its contents.

    A folder stands for its files' names, sizes and dates, without hidden folders,
    compiled Python and work folders of evaluations, which change while it is used.
    """
    return {key: _contents(value) for key, value in options.items()}


def _contents(value: Any) -> Any:
    if is_file(value):
        return bytes_hash(Path(value).read_bytes())
    if not (isinstance(value, str) and value and Path(value).is_dir()):
        return value
    lines = []
    for path in _files(Path(value)):
        facts = path.stat()
        name = path.relative_to(value).as_posix()
        lines.append(f"{name} {facts.st_size} {facts.st_mtime_ns}\n")
    return bytes_hash("".join(sorted(lines)).encode(errors="surrogateescape"))


def _files(folder: Path) -> Iterator[Path]:
    for path in folder.iterdir():
        hidden = path.name.startswith(".") or path.name == "__pycache__"
        if path.is_file():
            yield path
        elif path.is_dir() and not (
            hidden or path.is_symlink() or is_work_folder(path)
        ):
            yield from _files(path)


def bytes_hash(data: bytes) -> str:
    """A hash of a file's contents."""
    return hashlib.blake2b(data, digest_size=16).hexdigest()
