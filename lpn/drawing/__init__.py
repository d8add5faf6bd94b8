"""Drawings and sentences about results, for the app, the reports, and the command line.

`overlays` draws on pictures, `captions` writes text on them, `charts` makes inline SVG, `verdicts` makes sentences, and
`theme` has the colours. The package imports `analysis` and the packages below it.
"""
