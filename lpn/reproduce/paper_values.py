"""The paper's values in percent, and its claims (Wang et al., "Each Part Matters", section IV)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

BOTH_WAYS = ("drone → satellite R@1", "drone → satellite AP", "satellite → drone R@1", "satellite → drone AP")
GROUND = ("R@1", "R@5", "R@10", "R@Top1%")
LANDMARKS = ("Oxford mAP", "Paris mAP")
CENTRE = ("drone pictures, % of activation", "satellite tiles, % of activation")

Values = tuple[float, ...]
# A row of the paper; None where it prints a dash.
PrintedValues = tuple[float | None, ...]

TABLE1: dict[str, Values] = {
    "Instance loss (baseline)": (58.49, 63.13, 71.18, 58.74),
    "Contrastive loss": (52.39, 57.44, 63.91, 52.24),
    "Triplet loss, margin 0.3": (55.18, 59.97, 63.62, 53.85),
    "Triplet loss, margin 0.5": (53.58, 58.60, 64.48, 53.15),
    "Weighted soft-margin triplet loss": (53.21, 58.03, 65.62, 54.47),
    "LPN without google": (74.18, 77.39, 85.16, 73.68),
    "LPN": (75.93, 79.14, 86.45, 74.79),
}
TABLE2: dict[str, Values] = {
    "Instance loss (baseline)": (43.91, 66.38, 74.58, 91.78),
    # The paper prints one row for LPN. Its text describes the sequential partition, and its released code uses rings and rows.
    "LPN, sequential partition": (78.48, 92.46, 95.29, 99.12),
    "LPN, rings and rows": (78.48, 92.46, 95.29, 99.12),
    "SAFA": (89.84, 96.93, 98.14, 99.64),
    "SAFA + LPN": (92.83, 98.00, 98.85, 99.78),
}
# Methods of Table II that the paper quotes, with publication and backbone.
TABLE2_QUOTED: dict[str, PrintedValues] = {
    "MCVPlaces (ICCV'15, AlexNet)": (None, None, None, 34.40),
    "Zhai (CVPR'17, VGG16)": (None, None, None, 43.20),
    "Vo (ECCV'16, AlexNet)": (None, None, None, 63.70),
    "CVM-Net (CVPR'18, VGG16)": (18.80, 44.42, 57.47, 91.54),
    "Orientation, with orientation as input (CVPR'19, VGG16)": (27.15, 54.66, 67.54, 93.91),
    "Regmi (ICCV'19, X-Fork)": (48.75, None, 81.27, 95.98),
    "Siam-FCANet (ICCV'19, ResNet)": (None, None, None, 98.30),
    "CVFT (AAAI'20, VGG16)": (61.43, 84.69, 90.94, 99.02),
}
TABLE3: dict[int, Values] = {
    224: (69.28, 72.98, 82.45, 68.92),
    256: (75.93, 79.14, 86.45, 74.79),
    320: (77.65, 80.56, 85.31, 75.36),
    384: (78.02, 80.99, 86.16, 76.56),
    512: (77.71, 80.80, 90.30, 78.78),
}
TABLE4: dict[int, Values] = {
    0: (75.93, 79.14, 86.45, 74.79),
    45: (72.04, 75.62, 85.16, 72.27),
    90: (68.80, 72.67, 86.31, 75.31),
    180: (70.76, 74.47, 85.45, 74.03),
    270: (69.06, 72.49, 86.73, 75.12),
}
TABLE5: dict[str, Values] = {
    "1": (71.95, 75.50, 84.02, 70.24),
    "2": (71.94, 75.49, 83.74, 71.32),
    "3": (71.97, 75.62, 85.45, 71.61),
    "4": (70.75, 74.41, 82.03, 69.50),
    "1+2": (74.85, 78.14, 85.59, 73.69),
    "1+2+3": (75.74, 78.97, 86.31, 74.76),
    "1+2+3+4": (75.93, 79.14, 86.45, 74.79),
}
TABLE6: dict[str, Values] = {
    "ImageNet alone": (8.43, 27.93),
    "Baseline, satellite branch": (15.62, 38.18),
    "Baseline, ground branch": (41.12, 59.00),
    "LPN, satellite branch": (27.02, 45.81),
    "LPN, ground branch": (51.71, 67.73),
}


# Figure 5 prints a curve; its ends n = 1 and n = 4 are rows of Table I.
FIGURE5: dict[int, Values] = {1: TABLE1["Instance loss (baseline)"], 4: TABLE1["LPN"]}

RowPair = tuple[str, str]


@dataclass(frozen=True)
class Claim:
    """A claim of the paper: in some columns, one row of each pair is ahead of the other.

    Attributes:
        text: the claim in our words, with its place in the paper.
        pairs: the row that should be ahead, and the other one.
        columns: indices of the compared columns; None for every measured column.
        tolerance: None for a claim that the first row is ahead. For a claim that it is not, the points by which it may still
            be ahead, for each of `columns`.
    """

    text: str
    pairs: tuple[RowPair, ...]
    columns: tuple[int, ...] | None = None
    tolerance: tuple[float, ...] | None = None


def _ahead(row: str, *others: str) -> tuple[RowPair, ...]:
    return tuple((row, other) for other in others)


def _rising(*rows: str) -> tuple[RowPair, ...]:
    return tuple((better, worse) for worse, better in pairwise(rows))


def largest_drop(column: int) -> float:
    """Return the largest loss by a rotation of the queries in a column of Table IV; the paper calls it insignificant."""
    return round(max(TABLE4[0][column] - values[column] for values in TABLE4.values()), 2)


def _no_drop(text: str, columns: tuple[int, int]) -> Claim:
    upright, *turned = (f"LPN, {angle}°" for angle in TABLE4)
    return Claim(text, _ahead(upright, *turned), columns, (largest_drop(columns[0]), largest_drop(columns[1])))


_METRIC_LOSSES = tuple(TABLE1)[1:5]
_DRONE, _SATELLITE = (0, 1), (2, 3)

CLAIMS: dict[str, tuple[Claim, ...]] = {
    "table1": (
        Claim(
            "LPN retrieves more than the baseline of global features, in both directions (abstract, Table I)",
            _ahead("LPN", "Instance loss (baseline)"),
        ),
        Claim(
            "The instance loss retrieves more than the losses on distances (Table I)",
            _ahead("Instance loss (baseline)", *_METRIC_LOSSES),
        ),
        Claim("Pictures of the ground from Google add to LPN (Table I)", _ahead("LPN", "LPN without google")),
    ),
    "table2": (
        Claim(
            "LPN with the sequential partition of the text retrieves more than the baseline between ground and satellite "
            "(Table II)",
            _ahead("LPN, sequential partition", "Instance loss (baseline)"),
        ),
        Claim(
            "LPN with the rings and rows of the released run retrieves more than the baseline between ground and satellite "
            "(Table II)",
            _ahead("LPN, rings and rows", "Instance loss (baseline)"),
        ),
        Claim("LPN embedded into SAFA adds to it (abstract, Table II)", _ahead("SAFA + LPN", "SAFA")),
    ),
    "table3": (
        Claim(
            "Larger inputs help drone queries, at each step from 224 to 384 pixels (Table III)",
            _rising("224", "256", "320", "384"),
            _DRONE,
        ),
        Claim("512 pixels bring drone queries nothing over 384 (Table III)", _ahead("512", "384"), _DRONE, (0.0, 0.0)),
        Claim(
            "512 pixels are best for satellite queries (Table III)",
            _ahead("512", "224", "256", "320", "384"),
            _SATELLITE,
        ),
        Claim("384 pixels retrieve more than 224, in both directions (section IV-D, Table III)", _ahead("384", "224")),
    ),
    "table4": (
        _no_drop("Turned drone queries show no significant drop (Table IV)", _DRONE),
        _no_drop("Turned satellite queries show no significant drop (Table IV)", _SATELLITE),
    ),
    "table5": (
        Claim(
            "Parts complement one another: all parts together are ahead of each part alone (Table V)",
            _ahead("1+2+3+4", "1", "2", "3", "4"),
        ),
        Claim("Each further part adds to those inside it (Table V)", _rising("1", "1+2", "1+2+3", "1+2+3+4")),
    ),
    "table6": (
        Claim(
            "LPN's features carry further than the baseline's, in either branch (Table VI)",
            (
                ("LPN, satellite branch", "Baseline, satellite branch"),
                ("LPN, ground branch", "Baseline, ground branch"),
            ),
        ),
        Claim(
            "The ground branch is ahead of the satellite branch (Table VI)",
            (
                ("Baseline, ground branch", "Baseline, satellite branch"),
                ("LPN, ground branch", "LPN, satellite branch"),
            ),
        ),
        Claim(
            "Every trained branch is ahead of ImageNet's features (Table VI)",
            tuple((row, "ImageNet alone") for row in tuple(TABLE6)[1:]),
        ),
    ),
    "figure5": (
        Claim("R@1 and AP rise with n up to n = 4 (Figure 5)", _rising("n = 1", "n = 2", "n = 4")),
        Claim("n = 4 is the peak: n = 6 and 8 lie below (Figure 5)", _ahead("n = 4", "n = 6", "n = 8")),
    ),
    "figure7": (
        Claim(
            "The baseline responds to the centre of a picture, LPN to its surroundings too (Figure 7)",
            _ahead("Baseline, n = 1", "LPN, n = 4"),
        ),
    ),
}
