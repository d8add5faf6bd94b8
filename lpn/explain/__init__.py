"""Explanations of a rank: exact evidence, counterfactuals, occlusion, and sweeps over turn, shift, and zoom.

It imports `retrieval` and the packages below it.
"""

from lpn.explain.attribution import (
    Correspondences,
    Evidence,
    SideEvidence,
    cell_similarities,
    correspondences,
    evidence,
    lead_cells,
    side_evidence,
    spread_constants,
)

__all__ = [
    "Correspondences",
    "Evidence",
    "SideEvidence",
    "cell_similarities",
    "correspondences",
    "evidence",
    "lead_cells",
    "side_evidence",
    "spread_constants",
]
