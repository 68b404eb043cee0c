"""The names of all methods: a baseline is added here, by a row."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple


class Baseline(NamedTuple):
    """Where a baseline is."""

    about: str  # what it is, one line for the reader of a report
    module: str  # in `unips_jax.baselines`
    factory: str  # in that module; its keyword arguments are the method's options
    fixed: Mapping[str, Any] = MappingProxyType({})  # options that the name stands for
    # whose weights the option `weights` must give; "" where it needs none
    network: str = ""


BASELINES: dict[str, Baseline] = {
    "gcnet": Baseline(
        "GCNet (Chen et al., ECCV 2020), re-implemented, with the weights given: "
        "lights estimated, then normals by a calibrated method",
        "gcnet.pipeline",
        "gcnet",
        network="gcnet",
    ),
    "lcnet": Baseline(
        "LCNet (SDPS-Net, Chen et al., CVPR 2019), re-implemented, with the weights "
        "given: lights estimated, then normals by a calibrated method",
        "gcnet.pipeline",
        "lcnet",
        network="lcnet",
    ),
    "ps-fcn": Baseline(
        "PS-FCN (Chen et al., ECCV 2018), re-implemented, with the weights given; "
        "calibrated",
        "gcnet.pipeline",
        "ps_fcn",
        network="ps_fcn",
    ),
    "mpm": Baseline(
        "MPM-style: our reconstruction from the idea of Mo et al. (CVPR 2018); the "
        "authors' code is not public. Uncalibrated, orthographic, convex objects",
        "mpm.pipeline",
        "mpm",
    ),
    "variational": Baseline(
        "Variational (Haefner et al., ICCV 2019), re-implemented. Uncalibrated; "
        "Lambertian, starts from a balloon",
        "variational.pipeline",
        "variational",
    ),
    "woodham": Baseline(
        "Least squares, calibrated, with the recipe of the DiLiGenT table",
        "calibrated",
        "woodham_diligent",
    ),
    "least-squares": Baseline(
        "Least squares (Woodham, 1980), calibrated", "calibrated", "woodham"
    ),
    "l1": Baseline(
        "Least absolute residuals by reweighting, calibrated", "calibrated", "robust_l1"
    ),
    "sbl": Baseline(
        "Sparse Bayesian learning (Ikehata et al., CVPR 2012), calibrated",
        "calibrated",
        "sparse_bayesian",
    ),
    "rpca": Baseline(
        "Low rank and sparse outliers (Wu et al., ACCV 2010), calibrated",
        "calibrated",
        "low_rank",
    ),
    "diffuse-maxima": Baseline(
        "Factorisation; bas-relief ambiguity resolved by diffuse maxima. Uncalibrated, "
        "directional light",
        "uncalibrated",
        "factorisation",
        {"resolve": "diffuse_maxima"},
    ),
    "entropy": Baseline(
        "Factorisation; bas-relief ambiguity resolved by the albedo's entropy. "
        "Uncalibrated, directional light",
        "uncalibrated",
        "factorisation",
        {"resolve": "entropy"},
    ),
    "sh1": Baseline(
        "First-order spherical harmonics. Uncalibrated, natural light",
        "spherical_harmonics",
        "first_order_harmonics",
    ),
    "hemisphere": Baseline(
        "Floor: a balloon over the mask, images not looked at", "balloon", "hemisphere"
    ),
    "constant": Baseline(
        "Floor: every normal towards the viewer", "constant", "constant"
    ),
}

CLASSICAL = "woodham l1 sbl rpca diffuse-maxima entropy sh1 hemisphere constant".split()
"""What `classical` stands for on the command line."""

NAMES = ("unips", *BASELINES)
