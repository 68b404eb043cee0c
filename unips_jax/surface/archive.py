"""All results in one file, with names that hold the object's, and a text on each."""

import io
import zipfile
from pathlib import Path

_WHAT = {
    ".glb": "the surface with a material, for Blender and games, in metres",
    ".stl": "the surface as a solid on a base, to print, in millimetres",
    "normals.png": "normal map, 16 bits: {}",
    "normals.npy": "the normals as an array [H, W, 3], float32, 0: no surface",
    "normals.exr": "the normals as an image of floats: {}",
    "normals.mat": "the normals for MATLAB, key Normal_est",
    "normals.json": "how the normals came about: photographs, weights, options",
    "sheet.png": "photographs and normals on one sheet",
    "mask.png": "where the object is",
    "depth.exr": "depth, float32, away from the viewer; NaN: no surface",
    "depth.png": "depth, 16 bits: 1 nearest, 65535 farthest, 0 no surface",
    "height.png": "height for displacement, 16 bits: 65535 nearest",
    "surface.json": "camera, unit and scale of the depth",
    "mesh.glb": "the surface, with colours where some were given",
    "mesh.ply": "the surface, with colours where some were given",
    "mesh.obj": "the surface, with colours where some were given",
    "view.html": "a page to look at all of it in a browser, without a network",
    "lights.json": "each photograph's light; its conventions are in the file",
    "lights.lp": "the lights' directions, as RTI software reads them",
    "base_color.exr": "base colour, linear, up to one factor",
    "base_color.png": "base colour, 16 bits, sRGB",
    "relight.ptm": "a polynomial texture map, for RTI viewers",
    "info.json": "the texture map for web pages, with plane_0.jpg to plane_5.jpg; "
    "viewers look for these names, without the object's",
    "confidence.exr": "spread of the normals over halves of the photographs, "
    "degrees; NaN: no surface",
    "confidence.png": "spread of the normals, hundredths of degrees, 16 bits",
    "unreliable.png": "white where the normals are not to be trusted",
}

_AXES = {
    "opengl": "x right, y up (OpenGL), z to the viewer",
    "directx": "x right, y down (DirectX), z to the viewer",
    "opencv": "x right, y down, z away from the viewer (OpenCV)",
    "x-left": "x left, y up, z to the viewer",
}


def archive(name: str, files: list[Path], normal_map: str = "opengl") -> bytes:
    """A ZIP of files with the object's name in theirs, and a text on each.

    `normal_map`: the convention of the normals' pictures.
    """
    lines = [f"{name}: normals by unips_jax, and what follows from them.", ""]
    data = io.BytesIO()
    # Files of before 1980 get the first date that there is.
    with zipfile.ZipFile(
        data, "w", zipfile.ZIP_DEFLATED, strict_timestamps=False
    ) as packed:
        for file in files:
            own = file.name in (f"{name}.glb", f"{name}.stl")
            title = file.name if own else f"{name}-{file.name}"
            packed.write(file, f"{name}/{title}")
            what = _WHAT.get(file.suffix if own else file.name)
            if what is not None:
                lines.append(f"{title}: {what.format(_AXES[normal_map])}")
        packed.writestr(f"{name}/{name}-README.txt", "\n".join(lines) + "\n")
    return data.getvalue()
