"""What importing the package pulls in."""

import subprocess
import sys

import pytest

import unips_jax


def modules_after(code):
    """The modules loaded in a new process that runs the code."""
    code += "; import sys; print(*sys.modules)"
    run = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    )
    return set(run.stdout.split())


@pytest.mark.parametrize(
    ("code", "absent"),
    [
        (
            "import unips_jax",
            {"numpy", "jax", "orbax", "grain", "cv2", "matplotlib", "tyro"},
        ),
        ("import unips_jax; unips_jax.read_photographs", {"jax", "matplotlib", "tyro"}),
        (
            "import unips_jax; unips_jax.estimate_normals; unips_jax.load_weights",
            {"unips_jax.scenes", "orbax", "grain", "cv2", "matplotlib", "tyro"},
        ),
        (
            "import unips_jax.cli.estimate, unips_jax.cli.demo, unips_jax.cli.view, "
            "unips_jax.cli.surface, unips_jax.pictures.lettering as letters, numpy; "
            "letters.write_line(numpy.zeros((30, 90, 3), 'u1'), (0, 15), 'Größe', "
            "size=15, colour='white')",
            {"matplotlib", "unips_jax.evaluation"},
        ),
    ],
)
def test_import_is_light(code, absent):
    modules = modules_after(code)
    assert "unips_jax" in modules
    assert not absent & modules


def test_every_public_name_is_there():
    names = set(unips_jax.__all__)
    assert names <= set(dir(unips_jax))
    for name in names - {"__version__"}:
        value = getattr(unips_jax, name)
        assert callable(value) and value.__name__ == name
        assert value.__doc__
    with pytest.raises(AttributeError, match="no attribute 'estimate_normal'"):
        _ = unips_jax.estimate_normal
    with pytest.raises(ImportError, match="nothing_of_this_name"):
        exec("from unips_jax import nothing_of_this_name")
