"""Miniature sets of every benchmark, and the ways in which each can be broken."""

import itertools
import json
import shutil
import zlib

import cv2
import evaluation_data as data
import numpy as np
from scipy.io import loadmat, savemat

SETS = {
    "ps-wild": (data.make_ps_wild, {"objects": 1, "lightings": ("directional",)}, ()),
    "ps-wild-train": (data.make_ps_wild_train, {}, ("anvil",)),
    "diligent": (data.make_diligent, {"objects": ("ball", "bear")}, ("ball", "bear")),
    "diligent-mv": (data.make_diligent_mv, {"objects": ("cow",)}, ("cow/view_02",)),
    "luces": (data.make_luces, {"objects": ("Cup",)}, ("Cup",)),
    "uw": (data.make_uw, {}, ("gray",)),
    "folder": (data.make_folder, {}, ()),
}
PS_WILD = "directional/obj000.data/"
PHOTOGRAPHS = {
    "ps-wild": PS_WILD + "L_02.png",
    "ps-wild-train": "anvil.data/004.tif",
    "diligent": "pmsData/bearPNG/022.png",
    "diligent-mv": "mvpmsData/cowPNG/view_02/002.png",
    "luces": "data/Cup/17.png",
    "uw": "psmImages/gray/gray.7.png",
    "folder": "shoe/IMG_9.PNG",
}
MASKS = {
    "ps-wild": PS_WILD + "mask.png",
    "diligent": "pmsData/ballPNG/mask.png",
    "diligent-mv": "mvpmsData/cowPNG/view_02/mask.png",
    "luces": "data/Cup/mask.png",
    "uw": "psmImages/gray/gray.mask.png",
    "folder": "cup/mask.png",
}
TRUTHS = {
    "ps-wild": PS_WILD + "normal.tif",
    "ps-wild-train": "anvil.data/normal.tif",
    "luces": "data/Cup/normals.png",
    "folder": "cup/normal.png",
}
MATS = {
    "diligent": "pmsData/ballPNG/Normal_gt.mat",
    "diligent-mv": "mvpmsData/cowPNG/view_02/Normal_gt.mat",
}
DIRECTIONS = {
    "diligent": "pmsData/ballPNG/light_directions.txt",
    "diligent-mv": "mvpmsData/cowPNG/view_02/light_directions.txt",
    "uw": "psmImages/lights.txt",
}
INTENSITIES = {
    "diligent": "pmsData/bearPNG/light_intensities.txt",
    "diligent-mv": "mvpmsData/cowPNG/view_02/light_intensities.txt",
}
LISTS = {
    "diligent": "pmsData/ballPNG/filenames.txt",
    "diligent-mv": "mvpmsData/cowPNG/view_02/filenames.txt",
    "uw": "psmImages/gray.txt",
}


# Damage to any file.
def cut(share):
    def damage(path):
        content = path.read_bytes()
        path.write_bytes(content[: int(share * len(content))])

    damage.__name__ = f"cut_to_{share}"
    return damage


def lose_last_byte(path):
    path.write_bytes(path.read_bytes()[:-1])


def empty(path):
    path.write_bytes(b"")


def noise(path):
    path.write_bytes(np.random.default_rng(1).bytes(400))


def remove(path):
    path.unlink()


def flip_bits(path):
    content = bytearray(path.read_bytes())
    rng = np.random.default_rng(zlib.crc32(path.name.encode()))
    for position in rng.integers(33, len(content) - 12, 3):
        content[position] ^= 0x5A
    path.write_bytes(content)


# Damage to images.
def edit(change):
    def damage(path):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert cv2.imwrite(str(path), np.ascontiguousarray(change(image)))

    damage.__name__ = change.__name__
    return damage


def grey(image):
    return image[..., 0]


def with_alpha(image):
    return np.dstack([image, image[..., 0]])


def one_row_less(image):
    return image[1:]


def transposed(image):
    return np.swapaxes(image, 0, 1)[:, 1:]


def eight_bits(image):
    return (image >> 8).astype(np.uint8)


def black(image):
    return image * 0


def mid_grey(image):
    return np.full_like(image, 32768)


# Damage to tables.
def rewrite(change):
    def damage(path):
        path.write_text(change(path.read_text()))

    damage.__name__ = change.__name__
    return damage


def line_less(text):
    return text.strip().rsplit("\n", 1)[0]


def line_more(text):
    return text.strip() + "\n0.1 0.2 0.97"


def number_less(text):
    return text.strip().rsplit(" ", 1)[0]


def word(text):
    return text.strip().rsplit(" ", 1)[0] + " east"


def infinite(text):
    return text.strip().rsplit(" ", 1)[0] + " inf"


def zeros(text):
    return text.strip().rsplit("\n", 1)[0] + "\n0 0 0"


def negative(text):
    return text.strip().rsplit("\n", 1)[0] + "\n-1 1 1"


def name_of_nothing(text):
    return text.replace("2.png", "2.jpg", 1).replace("gray.2.jpg", "grey2.png")


def name_more(text):
    return text.strip() + "\nextra.png"


def no_lines(text):
    return " \n\n"


def name_outside(text):
    return text.replace("001.png", "../../../001.png").replace("12\n", "13\n")


# Damage to MATLAB files.
def mat(change, key="Normal_gt"):
    def damage(path):
        content = {k: v for k, v in loadmat(path).items() if not k.startswith("__")}
        savemat(path, change(content, key))

    damage.__name__ = change.__name__
    return damage


def renamed(content, key):
    content["other"] = content.pop(key)
    return content


def flat(content, key):
    return {**content, key: content[key].reshape(-1, 3)}


def mirrored_size(content, key):
    return {**content, key: np.swapaxes(content[key], 0, 1)}


def not_finite(content, key):
    return {**content, key: content[key] * np.nan}


def words(content, key):
    return {**content, key: "north"}


def all_zero(content, key):
    return {**content, key: content[key] * 0}


def matlab_73(path):
    path.write_bytes(
        b"MATLAB 7.3 MAT-file".ljust(128) + b"\x89HDF\r\n\x1a\n" + b"0" * 99
    )


def camera(change, key):
    damage = mat(change, key)
    damage.__name__ = f"{change.__name__}_{key}"
    return damage


# Damage to meta.json.
def meta(**values):
    def damage(path):
        path.write_text(json.dumps({**json.loads(path.read_text()), **values}))

    damage.__name__ = "meta_" + "_".join(values)
    return damage


def json_list(path):
    path.write_text("[1, 2]")


# Damage to LUCES's own files.
def leds(number, line):
    def damage(path):
        lines = path.read_text().splitlines()
        lines[number] = line
        path.write_text("\n".join(lines))

    damage.__name__ = f"line_{number}_{line[:12]}"
    return damage


def depth(**arrays):
    def damage(path):
        np.savez(path, **arrays)

    damage.__name__ = "depth_" + "_".join(arrays)
    return damage


def pickled(path):
    np.savez(path, zgt=np.array([{"not": "numbers"}], object))


def missing_folder(path):
    shutil.rmtree(path)


def cases():
    """Set, file, damage."""
    torn = (cut(0.1), cut(0.5), cut(0.9), lose_last_byte, empty, noise, remove)
    for kind, name in PHOTOGRAPHS.items():
        strict = [edit(grey), edit(with_alpha)] if kind != "folder" else []
        depth_change = [edit(eight_bits)] if kind != "uw" else []
        png = [flip_bits] if name.lower().endswith("png") else []
        sizes = [edit(one_row_less), edit(transposed)]
        # A listed file must be there; one found by its pattern is then just not found.
        found = [] if kind in ("diligent", "diligent-mv", "luces", "uw") else [remove]
        for damage in (*torn, *strict, *depth_change, *png, *sizes):
            if damage not in found:
                yield kind, name, damage
    for kind, name in MASKS.items():
        optional = [remove] if kind in ("ps-wild", "folder") else []
        for damage in (*torn, flip_bits, edit(one_row_less), edit(black)):
            if damage not in optional:
                yield kind, name, damage
    for kind, name in TRUTHS.items():
        png = [flip_bits] if name.endswith("png") else []
        for damage in (*torn, *png, edit(grey), edit(one_row_less), edit(mid_grey)):
            if not (kind == "folder" and damage is remove):
                yield kind, name, damage
    changes = (renamed, flat, mirrored_size, not_finite, words, all_zero)
    for kind, name in MATS.items():
        for damage in (*torn, matlab_73, *map(mat, changes)):
            yield kind, name, damage
    texts = (line_less, line_more, number_less, word, infinite, no_lines)
    for kind, name in DIRECTIONS.items():
        for damage in (empty, noise, *map(rewrite, (*texts, zeros))):
            yield kind, name, damage
    for kind, name in INTENSITIES.items():
        for damage in (empty, noise, remove, *map(rewrite, (*texts, negative))):
            yield kind, name, damage
    for kind, name in LISTS.items():
        for change in (name_of_nothing, name_more, no_lines, name_outside):
            yield kind, name, rewrite(change)
    calibration = "mvpmsData/cowPNG/Calib_Results.mat"
    for damage in (*torn, matlab_73):
        yield "diligent-mv", calibration, damage
    for change, key in itertools.product((renamed, not_finite), ("KK", "Rc_2", "Tc_2")):
        yield "diligent-mv", calibration, camera(change, key)
    yield from _odd_cases()


def _odd_cases():
    odd_meta = (
        meta(light_directions=[[0, 0, 1]]),
        meta(light_directions=3),
        meta(light_directions=[[0, 1]] * 4),
        meta(light_directions=[[0, 0, 0]] * 4),
        meta(light_intensities=[[1, 1, 1]]),
        meta(light_intensities=["a"] * 4),
        meta(light_intensities=[[0, 1, 1]] * 4),
        meta(focal="long"),
        meta(focal=-3),
    )
    for damage in (*odd_meta, json_list, cut(0.5), empty, noise):
        yield "ps-wild", PS_WILD + "meta.json", damage
    lines = (
        (1, ""),
        (1, "52 12 16 22.5 8 6"),
        (1, "51 12 16 22.5 8 6 300"),
        (1, "52 12 16 0 8 6 300"),
        (1, "52 12 16 f 8 6 300"),
        (9, "1 2 3"),
        (9, "a b c d e f g h"),
        (9, "nan 0 0 0 0 -1 1 1"),
    )
    for damage in (*(leds(n, text) for n, text in lines), empty, noise, remove):
        yield "luces", "data/Cup/led_params.txt", damage
    shapes = (depth(other=np.zeros((12, 16))), depth(zgt=np.zeros((16, 12))))
    for damage in (*shapes, pickled, empty, noise, remove, cut(0.6)):
        yield "luces", "data/Cup/zgt.npz", damage
    for kind, name in (
        ("diligent", "pmsData/bearPNG"),
        ("luces", "data/Cup"),
        ("uw", "psmImages/gray"),
        ("diligent-mv", "mvpmsData/cowPNG/view_02"),
        ("ps-wild", "directional"),
        ("folder", "cup"),
    ):
        if kind != "folder":
            yield kind, name, missing_folder
