"""Ranking and its measures: scores of parts, exact ranks, metrics, and calibration without labels.

It imports `core`, `datasets`, `models`, and `descriptors`.
"""

from lpn.retrieval.gallery_search import DescribedPicture, Match, Ranking, describe_picture, describe_pictures, rank

__all__ = ["DescribedPicture", "Match", "Ranking", "describe_picture", "describe_pictures", "rank"]
