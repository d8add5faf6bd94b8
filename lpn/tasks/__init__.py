"""A task: queries, their gallery, and their truth, from any source; with outcomes, positions, and notes."""
