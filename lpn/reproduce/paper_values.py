"""The paper's values in percent, and its claims (Wang et al., "Each Part Matters", tables I to VI)."""

from __future__ import annotations

from dataclasses import dataclass

BOTH_WAYS = ("drone → satellite R@1", "drone → satellite AP", "satellite → drone R@1", "satellite → drone AP")
GROUND = ("R@1", "R@5", "R@10", "R@Top1%")
LANDMARKS = ("Oxford mAP", "Paris mAP")

Values = tuple[float, ...]

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
    "LPN, rings and rows": (78.48, 92.46, 95.29, 99.12),
    "SAFA": (89.84, 96.93, 98.14, 99.64),
    "SAFA + LPN": (92.83, 98.00, 98.85, 99.78),
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


@dataclass(frozen=True)
class Claim:
    """A claim that one row is better than others in a column, or as good.

    Attributes:
        text: the claim in words.
        better: the row that should be better.
        worse: the rows that should be worse.
        column: index of the compared column.
        keeps: if above 0, the rows should rather differ by at most this many points.
    """

    text: str
    better: str
    worse: tuple[str, ...]
    column: int = 0
    keeps: float = 0.0


CLAIMS: dict[str, tuple[Claim, ...]] = {
    "table1": (
        Claim("Context helps: LPN is ahead of the baseline", "LPN without google", ("Instance loss (baseline)",)),
        Claim(
            "The baseline's instance loss is ahead of losses on distances",
            "Instance loss (baseline)",
            (
                "Contrastive loss",
                "Triplet loss, margin 0.3",
                "Triplet loss, margin 0.5",
                "Weighted soft-margin triplet loss",
            ),
        ),
        Claim("More pictures of the ground help", "LPN", ("LPN without google",)),
    ),
    "table2": (
        Claim(
            "Parts help on panoramas: LPN is ahead of the baseline",
            "LPN, rings and rows",
            ("Instance loss (baseline)",),
        ),
        Claim(
            "Strips suit panoramas: LPN by columns is ahead of the baseline on the same unrolled tiles",
            "LPN, strips of unrolled tiles",
            ("Instance loss, unrolled tiles",),
        ),
        Claim("LPN adds to SAFA", "SAFA + LPN", ("SAFA",)),
    ),
    "table4": (
        Claim(
            "Satellite queries keep their accuracy when turned", "0", ("45", "90", "180", "270"), column=2, keeps=2.0
        ),
        Claim("Drone queries lose some when turned", "0", ("45", "90", "180", "270")),
    ),
    "table5": (
        Claim("Parts complement one another: all are ahead of each alone", "1+2+3+4", ("1", "2", "3", "4")),
        Claim("The outermost part still adds to the others", "1+2+3+4", ("1+2+3",)),
    ),
    "table6": (
        Claim("LPN's features carry further than the baseline's", "LPN, ground branch", ("Baseline, ground branch",)),
        Claim("The ground branch is ahead of the satellite's", "LPN, ground branch", ("LPN, satellite branch",)),
        Claim("Training is ahead of ImageNet alone", "LPN, ground branch", ("ImageNet alone",)),
    ),
    "figure5": (Claim("n = 4 is best", "n = 4", ("n = 1", "n = 2", "n = 6", "n = 8")),),
}
