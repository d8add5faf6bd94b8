"""Descriptors computed by many workers or machines with Ray, of pictures in folders or object storage.

It imports `descriptors` and the packages below it, and needs the extra `cluster`; `cli` imports it.
"""
