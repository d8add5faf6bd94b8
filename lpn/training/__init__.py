"""Training: `recipes` (data: recipes.toml), the training set and its batches, augmentation, losses, and a run's `trainer`.

It imports `retrieval` and the packages below it, `flight.maps`, and `flight.files`; `reproduce`, `doctor`, and `cli` import it.
It needs the extra `train`; `recipe` and `recipes` alone run without torch.
"""
