"""The panels beside the stage: query, parts, answer, and the command palette."""
