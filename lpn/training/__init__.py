"""Training: recipes, batches, losses, optimizer, resume state, and the log of a run.

It imports `retrieval` and the packages below it, `maps`, and `flights`; `report`, `reproduce`, `doctor`, and `cli` import it. It
needs the extra `train`; `lpn.training.recipes` alone runs without torch.
"""
