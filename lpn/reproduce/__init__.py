"""The paper's tables and figures, made again: what they need is trained, measured, and put beside the paper's values."""
