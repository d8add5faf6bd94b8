"""Descriptors computed by many workers or machines with Ray, and the parts that they write.

It imports `descriptors` and the packages below it, and needs the extra `cluster`; `index`, `doctor`, and `cli` import it.
"""
