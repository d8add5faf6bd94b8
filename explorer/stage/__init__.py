"""The 3-D stage of one browser: the compared pair, the ranked tiles, and the map. Imports the workspace, no panels."""
