"""Methods that are not ours: from the user's modules, and from installed packages.

`python:package.module:factory:option=value,...` calls `factory(option=value)`, which
returns a method: a function of one `Observed` (`unips_jax.baselines.method`) that gives
normals. `name=TITLE` among the options is what tables call it, unless the factory has a
`name` of its own. Modules are looked for in the current folder too. A package that
declares

    [project.entry-points."unips_jax.methods"]
    mine = "package.module:factory"

has its method evaluated by its name, `-m mine:option=value`.
"""

import hashlib
import importlib
import importlib.metadata
import inspect
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from unips_jax.errors import InputError
from unips_jax.evaluation.variants import (
    Variant,
    built,
    described,
    hashed,
    label_of,
    parse_options,
    take_oracle,
)

GROUP = "unips_jax.methods"


def installed() -> dict[str, str]:
    """The methods that installed packages bring: `module:factory` by name."""
    found = importlib.metadata.entry_points(group=GROUP)
    return {point.name: point.value for point in found}


def from_module(request: str) -> Variant:
    """The method of `python:package.module:factory:option=value,...`."""
    parts = request.split(":", 3)
    module, factory = [*parts[1:], "", ""][:2]
    if not module or not factory.isidentifier():
        raise InputError(
            f"method {request!r}: expected python:package.module:factory, and options "
            "after another colon"
        )
    options = parse_options(request, parts[3] if len(parts) > 3 else "")
    return _made(request, factory, module, factory, options)


def from_package(request: str, value: str) -> Variant:
    """A package's method, `module:factory`, requested as `name:option=value,...`."""
    name, _, text = request.partition(":")
    module, _, factory = value.partition(":")
    return _made(request, name, module, factory, parse_options(request, text))


def _made(
    request: str, name: str, module: str, factory: str, options: dict[str, Any]
) -> Variant:
    oracle = take_oracle(options)
    make, file = _factory(request, module, factory)
    title = "" if _takes_name(make) else str(options.pop("name", ""))
    advice = f"; {factory} is called with the options and returns the method"
    method = built(request, make, options, advice=advice)
    if not callable(method):
        raise InputError(
            f"method {request!r}: expected {factory} to return a method, a function of "
            f"what is observed, got {type(method).__name__}"
        )
    source = f"{module}:{factory}"
    key = {
        "method": source,
        "options": hashed(options),
        "oracle": oracle,
        "method_code": sources_hash(file),
    }
    first = (make.__doc__ or "").strip().split("\n")[0].rstrip(".")
    about = described(first or f"{source}, not of this package", oracle=oracle)
    label = label_of(title or name, {} if title else options, oracle=oracle)
    return Variant(label, key, method, about, oracle, foreign=True)


def _factory(
    request: str, module: str, factory: str
) -> tuple[Callable[..., Any], Path | None]:
    """The function, and the file that it is in."""
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    try:
        loaded = importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise InputError(
            f"method {request!r}: no module {error.name!r}; it is looked for in the "
            "current folder and among what is installed"
        ) from error
    except Exception as error:
        raise InputError(
            f"method {request!r}: importing {module} fails: "
            f"{type(error).__name__}: {error}"
        ) from error
    make = getattr(loaded, factory, None)
    if not callable(make):
        raise InputError(f"method {request!r}: {module} has no function {factory!r}")
    file = getattr(loaded, "__file__", None)
    return make, None if file is None else Path(file)


def _takes_name(make: Callable[..., Any]) -> bool:
    try:
        return "name" in inspect.signature(make).parameters
    except (TypeError, ValueError):  # of what is not written in Python
        return False


def sources_hash(file: Path | None) -> str:
    """A hash of a module's source, and of its whole package's where it is in one.

    Outside a package the modules beside it count that are imported.
    """
    digest = hashlib.blake2b(digest_size=8)
    if file is not None:
        top = file  # or the outermost package around it
        while (top.parent / "__init__.py").is_file():
            top = top.parent
        sources = top.rglob("*.py") if top.is_dir() else {file, *_imported_beside(file)}
        for path in sorted(sources):
            digest.update(path.relative_to(top.parent).as_posix().encode() + b"\0")
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _imported_beside(file: Path) -> Iterator[Path]:
    if file.parent.name in ("site-packages", "dist-packages"):
        return
    for module in list(sys.modules.values()):
        path = Path(getattr(module, "__file__", None) or "")
        if path.parent == file.parent and path.suffix == ".py":
            yield path
