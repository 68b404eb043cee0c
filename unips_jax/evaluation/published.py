"""Scores as printed by others, in degrees of mean angular error, to compare ours with.

PS-Wild-Test: UniPS (Ikehata, CVPR 2022), Tables 2-8. DiLiGenT: least squares as in the
benchmark's table (Shi et al., CVPR 2016), UniPS as in its paper, PF14, UPS-FCN,
SDPS-Net and GCNet + PS-FCN as in SCPS-NIR (Li & Li, CVPR 2022), the means of the others
as in their own papers. LUCES and DiLiGenT10^2: as in the papers of SDM-UniPS, MS-PS and
LINO-UniPS.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple


class Published(NamedTuple):
    """A row of someone's table."""

    method: str
    # degrees by lighting (PS-Wild) or by object, and `mean` where only that is printed
    scores: Mapping[str, float]
    group: str = "method"  # "method", or an ablation of UniPS
    images: int | None = None  # how many; None for all of the benchmark's


def _lightings(
    method: str,
    scores: Sequence[float],
    group: str = "method",
    images: int | None = None,
) -> Published:
    names = ("directional", "environment", "mixed")
    return Published(method, dict(zip(names, scores, strict=True)), group, images)


_DILIGENT = "ball bear buddha cat cow goblet harvest pot1 pot2 reading".split()


def _objects(method: str, printed_mean: float, text: str) -> Published:
    scores = [float(score) for score in text.split()]
    named = dict(zip(_DILIGENT, scores, strict=True))
    return Published(method, {**named, "mean": printed_mean})


def _means(**means: float) -> tuple[Published, ...]:
    return tuple(
        Published(name.replace("_", "-"), {"mean": mean})
        for name, mean in means.items()
    )


_PS_WILD = (
    _lightings("UniPS", (17.0, 14.5, 13.8)),
    _lightings("GCNet", (17.7, 24.8, 31.5)),
    _lightings("MPM", (32.9, 30.4, 30.8)),
    _lightings("Variational", (33.0, 37.5, 32.5)),
    _lightings("UniPS", (35.4, 27.2, 28.5), "images", 1),
    _lightings("UniPS", (22.6, 19.5, 20.6), "images", 4),
    _lightings("UniPS", (18.8, 16.5, 17.4), "images", 8),
    _lightings("UniPS", (17.5, 14.7, 15.6), "images", 16),
    _lightings("UniPS", (17.0, 14.5, 13.8), "images", 32),
    _lightings("no communication", (19.7, 16.8, 16.1), "communication"),
    _lightings("during the backbone", (22.5, 20.1, 19.4), "communication"),
    _lightings("before fusion", (17.0, 14.5, 13.8), "communication"),
    _lightings("after fusion", (25.6, 22.5, 21.1), "communication"),
    _lightings("canonical 128", (19.9, 18.1, 17.0), "canonical size"),
    _lightings("canonical 256", (19.7, 16.8, 16.1), "canonical size"),
    Published("uniform contexts", {"mean": 40.5}, "contexts"),
    _lightings("max-pooling", (59.3, 39.3, 39.0), "aggregation"),
    _lightings("3 layers + PMA", (19.7, 16.8, 16.1), "aggregation"),
    _lightings("6 layers", (37.5, 29.4, 30.6), "aggregation"),
    _lightings("ViL", (29.5, 23.2, 24.0), "backbone"),
    _lightings("ResNet-101", (48.6, 45.8, 45.2), "backbone"),
)

PUBLISHED: dict[str, tuple[Published, ...]] = {
    "ps-wild": _PS_WILD,
    "diligent": (
        _objects(
            "least squares",
            15.39,
            "4.10 8.39 14.92 8.41 25.60 18.50 30.62 8.89 14.65 19.80",
        ),
        _objects(
            "UniPS", 14.70, "4.90 9.10 19.40 13.00 11.60 24.20 25.20 10.80 9.90 18.80"
        ),
        _objects(
            "PF14", 16.66, "4.77 9.07 14.92 9.54 19.53 29.93 29.21 9.51 15.90 24.18"
        ),
        _objects(
            "UPS-FCN",
            16.02,
            "6.62 11.23 15.87 14.68 11.91 20.72 27.79 13.98 14.19 23.26",
        ),
        _objects(
            "SDPS-Net", 9.51, "2.77 6.89 8.97 8.06 8.48 11.91 17.43 8.14 7.50 14.90"
        ),
        _objects("GCNet", 8.70, "2.50 5.60 8.60 7.90 7.80 9.60 16.20 7.20 7.10 14.90"),
        *_means(
            PS_FCN=8.39,
            CNN_PS=7.62,
            PX_Net=6.33,
            SDM_UniPS=5.80,
            Uni_MS_PS=5.01,
            LINO_UniPS=4.65,
            GeoUniPS=4.65,
        ),
    ),
    "luces": _means(UniPS=23.77, SDM_UniPS=13.50, MS_PS=11.21, LINO_UniPS=9.43),
    "diligent102": _means(UniPS=23.79, SDM_UniPS=14.97, MS_PS=13.20, LINO_UniPS=12.21),
}


# How many objects the means are over, where nothing but means is printed.
_COUNTS = {"luces": 14, "diligent102": 100}

DATA = {
    "ps-wild": "PS-Wild-Test",
    "diligent": "DiLiGenT",
    "luces": "LUCES",
    "diligent102": "DiLiGenT10^2",
}
"""What the published scores of a benchmark were measured on."""


def mean(row: Published, evaluated: Sequence[str] = ()) -> float:
    """The row's printed mean, or that of its scores, of what was evaluated."""
    named = [name for name in row.scores if name != "mean"]
    shown = [row.scores[name] for name in named if name in evaluated]
    if shown and len(shown) < len(named):
        return sum(shown) / len(shown)
    if "mean" in row.scores:
        return row.scores["mean"]
    return sum(row.scores.values()) / len(row.scores)


def comparable(benchmark: str, evaluated: Sequence[str]) -> list[Published]:
    """A benchmark's rows whose mean compares with one over these objects and lightings.

    Rows that print nothing but a mean are over all of its objects.
    """
    rows = PUBLISHED.get(benchmark, ())
    known = {name for row in rows for name in row.scores} - {"mean"}
    whole = not known & set(evaluated) or known <= set(evaluated)
    if whole and len(evaluated) >= _COUNTS.get(benchmark, 0):
        return list(rows)
    return [row for row in rows if set(row.scores) != {"mean"}]
