"""The 3-D stage: the compared pair, the ranked tiles, and the map."""
