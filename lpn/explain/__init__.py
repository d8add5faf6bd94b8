"""The reasons for a rank: exact evidence, counterfactuals, occlusion, and sweeps over turn, shift, and zoom.

It imports `retrieval` and the packages below it.
"""

from lpn.explain.attribution import Correspondences, Evidence, Side, counterparts, evidence, links, side

__all__ = ["Correspondences", "Evidence", "Side", "counterparts", "evidence", "links", "side"]
