"""Feeds, from which a page fetches pieces while somebody scrolls or zooms; the lists of queries and of own pictures.

`panels` and `failure_lab` import it.
"""
