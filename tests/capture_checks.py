"""Findings of photographs in memory, and photographs that moved."""

import cv2

from unips_jax.capture.check import check_capture
from unips_jax.io.photographs import Capture

STRIPES = {"second": (0.25, 0.2, 0.1), "background": 0.02}


def check(images, mask, transfer="srgb", rule="8-bit values", **facts):
    capture = Capture(images, mask, transfer, rule, **facts)
    return check_capture(capture, [f"{i}.png" for i in range(len(images))])


def moved(image, right, down, turn=0.0):
    height, width = image.shape[:2]
    matrix = cv2.getRotationMatrix2D((width / 2, height / 2), turn, 1.0)
    matrix[:, 2] += right, down
    return cv2.warpAffine(
        image, matrix, (width, height), flags=3, borderMode=cv2.BORDER_REFLECT
    )
