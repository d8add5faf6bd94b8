"""Explanations of a rank: exact evidence, counterfactuals, occlusion, and sweeps over turn, shift, and zoom.

It imports `retrieval` and the packages below it.
"""

from lpn.explain.attribution import Correspondences as Correspondences
from lpn.explain.attribution import Evidence as Evidence
from lpn.explain.attribution import SideEvidence as SideEvidence
from lpn.explain.attribution import cell_similarities as cell_similarities
from lpn.explain.attribution import correspondences as correspondences
from lpn.explain.attribution import evidence as evidence
from lpn.explain.attribution import lead_cells as lead_cells
from lpn.explain.attribution import side_evidence as side_evidence
from lpn.explain.attribution import spread_constants as spread_constants
