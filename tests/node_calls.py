"""Functions of the pages' JavaScript, called in Node."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

# A module without its imports; typed arrays go there and back as lists.
_CALL = """
import { readFileSync } from "node:fs";
const [file, name] = process.argv.slice(1);
const own = readFileSync(file, "utf8").replace(/^import .*$/gm, "");
const known = "const encode = null, decode = null; class Refusal extends Error {}\\n";
const code = Buffer.from(known + own).toString("base64");
const module = await import("data:text/javascript;base64," + code);
const asked = JSON.parse(readFileSync(0, "utf8"), (_, value) =>
  value?.type ? new globalThis[value.type](value.values) : value);
console.log(JSON.stringify(module[name](...asked), (_, value) =>
  ArrayBuffer.isView(value) ? [...value] : value));
"""


def typed(values: np.ndarray, kind: str = "Float32Array") -> dict[str, Any]:
    """An array as JavaScript has it."""
    return {"type": kind, "values": np.asarray(values).ravel().tolist()}


def in_node(file: Path, name: str, *arguments: Any) -> Any:
    """What a module's function returns."""
    return printed(["--input-type=module", "-e", _CALL, str(file), name], arguments)


def printed(arguments: list[str], asked: Any) -> Any:
    """What Node prints as JSON; the test is skipped where it is not installed."""
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    run = subprocess.run(
        ["node", *arguments], input=json.dumps(asked), capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)
