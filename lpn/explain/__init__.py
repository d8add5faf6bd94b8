"""The reasons for a rank: exact evidence, counterfactuals, occlusion, and sweeps over turn, shift, and zoom.

It imports `retrieval` and the packages below it.
"""

from lpn.explain.attribution import Evidence, Mates, Side, counterparts, evidence, links, side

__all__ = ["Evidence", "Mates", "Side", "counterparts", "evidence", "links", "side"]
