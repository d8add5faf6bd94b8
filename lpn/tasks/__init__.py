"""A task: queries, their gallery, and their truth, whatever they were opened from; with outcomes, positions, and notes."""
