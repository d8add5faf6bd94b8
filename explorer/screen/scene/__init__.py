"""The place in 3-D: viser's scene in a frame of the screen, one for each tab, drawn from the same result as the rest."""
